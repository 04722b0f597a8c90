"""Knocks laid into a recording: they are where they are said to be, and what is said of them is counted rightly."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians
from typing import Any

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import (
    MOVED,
    CameraFrame,
    Decision,
    EgoMotion,
    EncodedImage,
    Estimate,
    FramePair,
    ImageFormat,
    LidarFrame,
    MovedWithin,
    Reason,
    Uncertainty,
    Verdict,
    Window,
)
from coec.config import CalibrationConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec_lab.experiments import mount_steps
from coec_lab.experiments.evaluation_schema import StepRow
from coec_lab.experiments.mount_steps import MountStep, MountStepTrial, try_mount_steps
from support.estimates import ESTIMATE_RIG, estimate

CONFIG = CalibrationConfig()


@pytest.fixture
def street() -> Window:
    """Six pairs, two seconds apart, taken in motion; nobody looks at the pictures."""
    rng, pairs = np.random.default_rng(1), []
    image = EncodedImage(ImageFormat.MONO8, 4, 3, bytes(12))
    for second in range(0, 12, 2):
        stamp_ns = second * 1_000_000_000
        xyz_m = rng.normal(size=(50, 3)).astype(np.float32) * 20
        sweep = LidarFrame(stamp_ns, "lidar", xyz_m, time_offset_s=np.linspace(-0.1, 0.0, 50, dtype=np.float32))
        motion = EgoMotion(stamp_ns, "ego", (8.0, 0.0, 0.0), (0.0, 0.0, 0.2))
        pairs.append(FramePair(CameraFrame(stamp_ns, "camera", image), sweep, motion))
    return Window("front-0", ESTIMATE_RIG, ESTIMATE_RIG.T_camera_lidar_nominal, tuple(pairs))


class Solver:
    """Stands in for `calibrate`: keeps the windows, and says of each what the test wants it to."""

    def __init__(self, says: Any) -> None:
        self.says = says
        self.windows: list[Window] = []

    def __call__(self, window: Window, *_: object) -> Estimate:
        self.windows.append(window)
        reported: Estimate = self.says(window)
        return reported


def at(window: Window, off_deg: float, sigma_deg: float = 0.01) -> Estimate:
    """Accepted, this far from the start."""
    made = estimate(1)
    pose = se3.perturb(window.T_camera_lidar_start, np.array([radians(off_deg), 0, 0, 0, 0, 0]))
    sigma = np.array([radians(sigma_deg)] * 3 + [np.nan] * 3)
    return replace(made, optimum=replace(made.optimum, T_camera_lidar=pose), uncertainty=Uncertainty.independent(sigma))


def refused(window: Window, first_late: int) -> Estimate:
    stamps_ns = [pair.stamp_ns for pair in window.pairs]
    pose = window.T_camera_lidar_start
    moved = MovedWithin(stamps_ns[first_late - 1], stamps_ns[first_late], len(stamps_ns) - first_late, pose, pose)
    return replace(at(window, 0.0), verdict=Verdict(Decision.FAILED, (), (Reason(MOVED, "moved"),)), moved=moved)


def tried(
    monkeypatch: pytest.MonkeyPatch, street: Window, solver: Solver, *knocks: MountStep, trials: int = 3
) -> list[MountStepTrial]:
    monkeypatch.setattr(mount_steps, "calibrate", solver)
    unused: Any = None
    return try_mount_steps(street, unused, unused, CONFIG, trials, knocks, lambda _: None)


def test_late_sweeps_are_as_if_the_mount_had_moved(street: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Solver(lambda window: at(window, 0.0))
    tried(monkeypatch, street, solver, MountStep("none", 0.0), MountStep("2 deg", radians(2.0)), trials=4)
    still, *displaced = solver.windows
    T = street.T_camera_lidar_start
    for before, pair in zip(street.pairs, still.pairs, strict=True):
        expected = compensate(before, street.rig, enabled=True)
        np.testing.assert_allclose(pair.lidar.xyz_m, expected, atol=1e-4)
    places = set()
    for window in displaced:
        carried = []
        for one, other in zip(still.pairs, window.pairs, strict=True):
            # Where the camera sees a point before and after tells by how much it was turned.
            a, b = (p.lidar.xyz_m.astype(float) @ T[:3, :3].T + T[:3, 3] for p in (one, other))
            u, _, vt = np.linalg.svd(b.T @ a)
            carried.append(degrees(se3.rotation_angle_rad(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)))
        late = [turned > 1.0 for turned in carried]
        assert late == sorted(late), "early ones stay, late ones are turned"
        assert not late[0]
        assert late[-1]
        np.testing.assert_allclose(carried, np.where(late, 2.0, 0.0), atol=0.01)
        places.add(late.index(True))
    assert len(places) > 1


def test_what_is_accepted_elsewhere_than_at_the_end_is_wrong(street: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    for sigma_deg, wrong in ((0.01, True), (0.6, False)):
        solver = Solver(lambda window, sigma_deg=sigma_deg: at(window, 0.0, sigma_deg))
        reported = tried(monkeypatch, street, solver, MountStep("none", 0.0), MountStep("2 deg", radians(2.0)))
        assert [one.wrong for one in reported] == [False, wrong, wrong, wrong]


def test_the_time_of_a_step_is_known_where_its_place_is(street: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    knock = MountStep("1 deg", radians(1.0))
    solver = Solver(lambda window: refused(window, 1))
    reported = tried(monkeypatch, street, solver, knock, trials=12)
    spacing_s = (street.pairs[1].stamp_ns - street.pairs[0].stamp_ns) / 1e9
    for one in reported:
        first_late = round((1.0 - one.late) * len(street.pairs))
        assert one.off_s is not None
        assert abs(one.off_s - (first_late - 1) * spacing_s) <= spacing_s / 2 + 1e-6
    (row,) = mount_steps.table(reported)
    assert row.time_known == np.mean(
        [one.off_s is not None and one.off_s <= mount_steps.KNOWN_TO_S for one in reported]
    )


def test_the_table_has_a_row_for_each_knock_in_their_order() -> None:
    def one(name: str, **reported: Any) -> MountStepTrial:
        plain = {"accepted": False, "wrong": False, "moved": False, "off_s": None, "interval_s": None, "holds": None}
        return MountStepTrial(name, **{**plain, "late": 0.5, **reported})

    reported = [one("none", accepted=True), one("1 deg", moved=True, off_s=1.0, interval_s=2.5, holds=True)]
    reported += [one("1 deg", accepted=True, wrong=True), one("1 deg, slowly", moved=True)]
    names = tuple(StepRow.model_fields)
    rows = [tuple(getattr(row, name) for name in names) for row in mount_steps.table(reported)]
    assert rows == [
        ("none", 1, 1.0, 0.0, 0.0, None, None, None, None),
        ("1 deg", 2, 0.5, 0.5, 0.5, 0.5, 1.0, 2.5, 1.0),
        ("1 deg, slowly", 1, 0.0, 0.0, 1.0, None, None, None, None),
    ]


def test_a_window_of_one_pair_has_no_time_for_a_knock(street: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    one = replace(street, pairs=street.pairs[:1])
    with pytest.raises(CalibrationError, match="between two pairs"):
        tried(monkeypatch, one, Solver(lambda window: at(window, 0.0)), MountStep("none", 0.0))
