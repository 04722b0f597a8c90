"""`coec resample`: windows drawn from a recording, and what their solves come to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cli.conftest import SMALL, Coec
from coec.calibration.types import Window
from coec.config import LimitsConfig
from coec.geometry import cameras
from coec.geometry.projection import project
from coec.io.images import decode_bgr
from coec_lab.experiments import resampled_statistics, resampled_windows
from coec_lab.experiments.resampled_statistics import ResampleReport, row_of
from coec_lab.experiments.resampled_windows import (
    LensError,
    Reference,
    ResampledSolve,
    Resampling,
    Sample,
    resampled,
    sampled,
)


@pytest.fixture
def window() -> Window:
    return resampled_windows._loaded(SMALL)


def test_a_seed_gives_the_same_windows_and_a_number_another(window: Window) -> None:
    one, again, other = (sampled(window, True, np.random.default_rng([1, number])) for number in (3, 3, 4))
    assert one == again != other
    assert one.lens is not None
    assert 3 <= len(one.frames) <= len(window.pairs)


def test_a_part_of_half_the_size_shows_points_at_the_pixels_that_its_camera_says(window: Window) -> None:
    rig = window.rig
    sample = Sample((1, 4), (20, 10, 120, 100), halved=True, ring_step=2, first_ring=1, lens=None)
    small = resampled(window, sample)
    assert [pair.stamp_ns for pair in small.pairs] == [window.pairs[k].stamp_ns for k in (1, 4)]
    assert (small.rig.camera.width, small.rig.camera.height) == (60, 50)
    point = np.array([[0.3, -0.2, 4.0]])
    whole_px, part_px = project(rig.camera, point)[0][0], project(small.rig.camera, point)[0][0]
    np.testing.assert_allclose((whole_px - [20.0, 10.0] + 0.5) / 2.0 - 0.5, part_px, atol=1e-9)
    whole, part = (decode_bgr(w.pairs[k].camera.image, LimitsConfig()) for w, k in ((window, 1), (small, 0)))
    pixels = whole[10:12, 20:22].astype(float).mean(axis=(0, 1))
    np.testing.assert_allclose(part[0, 0], pixels, atol=1.0)
    rings = small.pairs[0].lidar.ring
    assert rings is not None
    assert set(np.unique(rings % 2)) == {1}
    depth = small.pairs[0].camera.depth
    assert depth is not None
    assert (depth.width, depth.height) != (rig.camera.width, rig.camera.height)


def test_a_lens_error_changes_one_number(window: Window) -> None:
    camera = window.rig.camera
    right = cameras.intrinsics_of(camera)
    longer = cameras.intrinsics_of(LensError("f", 0.02).applied(camera))
    assert longer["fy"] == pytest.approx(1.02 * right["fy"])
    assert {name for name in right if right[name] != longer[name]} == {"fx", "fy"}
    assert LensError("cy", -5.0).applied(camera).cy == camera.cy - 5.0


def a_solve(number: int, error_deg: float, sigma_deg: float, *reasons: str) -> ResampledSolve:
    sample = Sample((0, 1, 2), (0, 0, 9, 9), halved=False, ring_step=1, first_ring=0, lens=None)
    error, sigma = np.full(6, np.nan), np.full(6, np.nan)
    error[:3], sigma[:3] = np.radians([error_deg, 0.0, 0.0]), np.radians(sigma_deg)
    return ResampledSolve(number, sample, error, sigma, accepted=not reasons, reasons=reasons)


def test_hits_wrong_results_and_standard_deviations_are_counted() -> None:
    solves = [
        a_solve(0, 0.1, 0.1),
        a_solve(0, -0.1, 0.2, "sigma_deg"),
        a_solve(1, 0.4, 0.05),
        a_solve(2, 3.0, 0.1, "runner_up"),
    ]
    of = Resampling("a", 3, 2, 20.0, 0.0, lens_errors=False, seed=1)
    row = row_of(of, Reference(np.eye(4), 8, 8, np.zeros(6)), solves)
    assert (row.windows, row.solves, row.hits, row.accepted, row.wrong_accepted) == (3, 4, 3, 2, 1)
    assert row.refused_by == {"sigma_deg": 1}
    assert row.covered[0] == pytest.approx(2 / 3)
    assert row.covered[3] is None
    assert row.verdicts_differ == 1
    assert row.sigma_spread == pytest.approx(0.1 / 0.15)
    lost = replace(solves[0], error=np.full(6, np.nan))
    assert row_of(of, Reference(np.eye(4), 8, 8, np.zeros(6)), [lost]).failed == 1


def test_windows_of_a_simulated_drive_are_solved_and_reported(
    coec: Coec, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resampled_windows, "CONSENSUS_STARTS", 2)
    report = ResampleReport.model_validate(
        coec(
            "resample", SMALL, "--windows", 2, "--starts", 1, "--dof", 3, "--rotation-deg", 2, "--lens-errors",
            "--depth", "stereo", "--jobs", 1, "--json",
        ).document
    )  # fmt: skip
    assert (report.rows[0].windows, report.rows[0].solves) == (2, 2)
    assert sum(row.solves for row in report.lenses) == 2
    resampled_statistics.show(report)
    shown = capsys.readouterr().out
    assert "reference, of" in shown
    assert "lens first" in shown
