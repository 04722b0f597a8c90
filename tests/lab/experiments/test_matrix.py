"""Figures of the matrix from rows made by hand, and the table of drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from coec.config import CalibrationConfig
from coec.io.recordings.recording_source import parse_spec
from coec.schemas.replies import Maybe6
from coec_lab.experiments import matrix_drives, matrix_statistics
from coec_lab.experiments.matrix_drives import FIRST_SEED, SEEDS
from coec_lab.experiments.simulation_schemas import MatrixRow, SolvedWindow, Watched
from coec_lab.simulation.faults import parse_fault
from coec_lab.simulation.lidar_model import LIDARS
from coec_lab.simulation.source import NUMBERS, TEXT_KEYS

DRIVES = matrix_drives.drives(1)
NOTHING: Maybe6 = (None,) * 6


def solved(
    error: Maybe6 = (0.1, 0.0, 0.0, None, None, None),
    sigma: Maybe6 = (0.1, 0.1, 0.1, None, None, None),
    *,
    accepted: bool = True,
    dof: int = 3,
    reasons: tuple[str, ...] = (),
) -> SolvedWindow:
    rotation, translation = (math.hypot(*(value or 0.0 for value in part)) for part in (error[:3], error[3:]))
    return SolvedWindow(
        pairs=10, start_deg=5.0, start_m=0.0, accepted=accepted,
        hit=matrix_statistics.is_hit(rotation, translation, dof),
        rotation_deg=rotation, translation_m=translation, error=error, sigma=sigma, reasons=reasons, evaluations=100,
        failure=None,
    )  # fmt: skip


UNSOLVED = SolvedWindow(
    pairs=3, start_deg=5.0, start_m=0.0, accepted=False, hit=False, rotation_deg=None, translation_m=None,
    error=NOTHING, sigma=NOTHING, reasons=(), evaluations=0, failure="CalibrationError: nothing to see",
)  # fmt: skip


def row(
    name: str, *windows: SolvedWindow, dof: int = 3, light: str = "day", watched: tuple[Watched, ...] = (),
    failure: str | None = None,
) -> MatrixRow:  # fmt: skip
    return MatrixRow(
        name=name, scene="street", lens="wide", lidar="64", light=light, fault="none", seed=1, source="sim:seed=1",
        windows={"3" if dof == 3 else "6": windows} if windows else {}, watched=watched, failure=failure, settings="",
        cpu_s=1.0,
    )  # fmt: skip


def watch(moved: str, alarms: int, *, flagged: int = 0, blind: int = 0, delay: int | None = None) -> Watched:
    return Watched(
        moved=moved, checks=5, flagged=flagged, blind=blind, alarms=alarms, seconds=1800.0, delay_checks=delay
    )


def test_a_hit_counts_the_translation_only_where_it_was_searched() -> None:
    assert matrix_statistics.is_hit(0.5, 9.0, 3)
    assert not matrix_statistics.is_hit(0.51, 0.0, 3)
    assert matrix_statistics.is_hit(0.5, 0.1, 6)
    assert not matrix_statistics.is_hit(0.1, 0.11, 6)


def test_errors_are_held_against_the_sigmas_of_accepted_windows() -> None:
    windows = [solved((e, 0.0, 0.0, None, None, None)) for e in (0.1, -0.1, 0.15, -0.25)]
    refused = solved((30.0, 0.0, 0.0, None, None, None), accepted=False, reasons=("runner_up",))
    (figures,) = matrix_statistics.report([row("a", *windows, refused, UNSOLVED)]).solves
    pitch = figures.axes[0]
    assert (figures.windows, figures.hits, figures.accepted, figures.accepted_hits) == (6, 4, 4, 4)
    assert (pitch.axis, pitch.windows) == ("rx", 4)
    assert pitch.bias == pytest.approx(-0.025)
    rms = math.sqrt((0.01 + 0.01 + 0.0225 + 0.0625) / 4)
    assert pitch.rms == pytest.approx(rms)
    assert pitch.rms_normalised == pytest.approx(10 * rms)
    assert pitch.sigma_over_rms == pytest.approx(0.1 / rms)
    assert (pitch.within_1, pitch.within_2, pitch.within_3) == (0.5, 0.75, 1.0)
    assert figures.axes[1].rms == 0.0
    assert figures.axes[1].sigma_over_rms is None  # no error to hold it against
    assert figures.reasons == {"runner_up": 1}


def test_an_axis_without_a_sigma_says_nothing_of_coverage() -> None:
    blind = solved((0.1, 0.0, 0.0, None, 0.02, 0.0), (0.1, 0.1, 0.1, None, 0.01, None), dof=6)
    (figures,) = matrix_statistics.report([row("a", blind, dof=6)]).solves
    assert [axis.windows for axis in figures.axes] == [1, 1, 1, 0, 1, 0]
    assert figures.axes[3].within_3 is None
    assert figures.axes[4].within_1 == 0.0


@pytest.mark.parametrize(
    ("error", "sigma", "wrong"),
    [(0.29, 0.01, False), (0.31, 0.01, True), (0.39, 0.1, False), (-0.41, 0.1, True), (0.31, None, True)],
)
def test_wrong_is_beyond_the_limit_and_beyond_four_sigma(error: float, sigma: float | None, wrong: bool) -> None:
    window = solved((0.0, error, 0.0, None, None, None), (0.1, sigma, 0.1, None, None, None))
    (figures,) = matrix_statistics.report([row("a", solved(), window)]).solves
    assert figures.accepted_wrong == int(wrong)
    assert [text.split(" ± ")[0] for text in figures.wrong] == ([f"a#2 ry {error:+.3f}"] if wrong else [])
    refused = window.model_copy(update={"accepted": False})
    assert matrix_statistics.wrong_axes("a", refused) == []


def test_groups_add_up_to_the_whole() -> None:
    rows = [row("a", solved(), solved()), row("b", solved(accepted=False), light="night"), row("c", failure="no file")]
    report = matrix_statistics.report(rows)
    (figures,) = report.solves
    lights = {group.value: group for group in figures.groups if group.of == "light"}
    assert {value: (group.windows, group.accepted) for value, group in lights.items()} == {
        "day": (2, 2),
        "night": (1, 0),
    }
    assert (report.drives, report.failed) == (3, {"c": "no file"})


def test_alarms_at_the_right_pose_are_false_and_elsewhere_requested() -> None:
    rows = [
        row("a", solved(), watched=(watch("right", 0, flagged=1), watch("1 deg", 1, flagged=5, delay=3))),
        row("b", solved(), watched=(watch("right", 1, flagged=3, delay=4, blind=1), watch("1 deg", 0))),
    ]
    right, off = matrix_statistics.report(rows).watched
    assert (right.moved, right.drives, right.checks, right.alarmed) == ("right", 2, 10, 1)
    assert right.flagged == pytest.approx(4 / 9)
    assert (right.hours, right.alarms_per_hour, right.names) == (1.0, 1.0, ("b",))
    assert (off.median_delay_checks, off.names) == (3.0, ("b",))


def test_nothing_is_no_division_by_it() -> None:
    report = matrix_statistics.report([row("a", failure="no file")])
    assert (report.solves, report.watched) == ((), ())
    (figures,) = matrix_statistics.report([row("a", UNSOLVED)]).solves
    assert figures.axes[0].rms is None


def test_the_matrix_is_large_and_every_drive_can_be_ordered() -> None:
    assert len(DRIVES) >= 60
    assert len({drive.name for drive in DRIVES}) == len(DRIVES)
    assert {drive.seed for drive in DRIVES} == set(range(FIRST_SEED, FIRST_SEED + SEEDS))
    for drive in DRIVES:
        query = parse_spec(drive.source(40.0, 0.5, depth=False)).query
        assert set(query) <= {*NUMBERS, *TEXT_KEYS}
        assert query["lidar"] in LIDARS
        for fault in filter(None, query.get("faults", "").split(";")):
            parse_fault(fault)


def test_a_round_has_the_same_kinds_of_drives_and_seeds_of_its_own() -> None:
    second = matrix_drives.drives(2)
    assert [one.name.rpartition("_s")[0] for one in second] == [one.name.rpartition("_s")[0] for one in DRIVES]
    assert not {one.seed for one in second} & {one.seed for one in DRIVES}
    assert {one.name.rpartition("_s")[2] for one in second} == {"4", "5", "6"}


def test_faults_of_scene_light_and_fault_go_together() -> None:
    drive = matrix_drives.MatrixDrive("tunnel", "fisheye", "64", "night", "dirt", FIRST_SEED)
    source = drive.source(40.0, 0.5, depth=True)
    assert parse_spec(source).query["faults"] == "tunnel:0;night:0;dirt:0:share=0.25"
    assert "depth=yes" in source


def test_drives_are_selected_by_their_name() -> None:
    night = matrix_drives.selected_drives(1, "*_night_*")
    assert night
    assert all(drive.light == "night" for drive in night)
    assert matrix_drives.selected_drives(1, None) == DRIVES
    assert matrix_drives.selected_drives(1, "moon") == ()
    assert CalibrationConfig().search.rotation_deg >= 10.0  # the box holds the farthest start


def test_a_start_is_off_by_what_is_searched_and_what_is_held_by_what_the_budget_says() -> None:
    held = np.array([matrix_drives.sampled_start(drive.name, 0, 3, 0.01) for drive in DRIVES])
    searched = np.array([matrix_drives.sampled_start(drive.name, 0, 6, 0.01) for drive in DRIVES])
    for rendered in (held, searched):
        turned = np.degrees(np.linalg.norm(rendered[:, :3], axis=1))
        assert (turned >= 2.0).all()
        assert (turned <= 10.0).all()
    np.testing.assert_allclose(held[:, 3:].std(axis=0), 0.01, rtol=0.3)
    shifted = np.linalg.norm(searched[:, 3:], axis=1)
    assert shifted.max() <= 0.1
    assert shifted.mean() > 0.03
    np.testing.assert_array_equal(held[0], matrix_drives.sampled_start(DRIVES[0].name, 0, 3, 0.01))
