"""What the change detector makes of rows of checks that were made by hand."""

from __future__ import annotations

from math import radians

import pytest

from coec.calibration.baseline import poisson_most
from coec.schemas.replies import Vector6
from coec_lab.experiments import check_drives
from coec_lab.experiments.check_statistics import report
from coec_lab.experiments.simulation_schemas import CheckedDrive, CheckedPose, Judged, MovedStatistics


def judged(
    pitch_deg: float, *, undecided: bool = False, faint: tuple[str, ...] = (), causes: tuple[str, ...] = ()
) -> Judged:
    sigma: Vector6 = (0.002, 0.002, 0.002, 0.03, 0.03, 0.03)
    noise: Vector6 = (0.001, 0.001, 0.001, 0.01, 0.01, 0.01)
    return Judged(
        offset=(radians(pitch_deg), 0.0, 0.0, 0.0, 0.0, 0.0), sigma=sigma, noise=noise, place=noise,
        dispersion=1.0, distance2=(radians(pitch_deg) / 0.007) ** 2,
        flagged=abs(radians(pitch_deg)) > 0.007 and not undecided, undecided=undecided, faint=faint, causes=causes,
    )  # fmt: skip


def driven(place: str, seed: int, right: tuple[Judged, ...], moved: tuple[Judged, ...] = ()) -> CheckedDrive:
    poses = [CheckedPose(moved="right", uncommissioned=right, commissioned=())]
    poses += [CheckedPose(moved="1 deg", uncommissioned=moved, commissioned=())] if moved else []
    return CheckedDrive(name=f"{place}{seed}", rig="a", place=place, seed=seed, source="sim:seed=1", poses=tuple(poses))


def of(rows: list[CheckedDrive], moved: str) -> MovedStatistics:
    (statistics,) = (row for row in report(rows, 0.0).rigs[0].moved if row.moved == moved)
    return statistics


def test_shares_are_of_checks_that_can_decide() -> None:
    right = (
        judged(0.0), judged(1.0), judged(1.0, undecided=True), judged(1.0, faint=("looks",)),
        judged(1.0, causes=("dark",)),
    )  # fmt: skip
    rows = [driven("street", 1, right)]
    figures = of(rows, "right")
    assert (figures.checks, figures.blind, figures.weak, figures.undecided) == (5, 1, 1, 1)
    assert (figures.clear, figures.flagged) == (2, 1)
    (street,) = report(rows, 0.0).rigs[0].places
    assert (street.place, street.checks, street.blind, street.weak) == ("street", 5, 1, 1)
    assert (street.undecided, street.flagged) == (1, 1)
    assert figures.flagged_low is not None
    assert figures.flagged_high is not None
    assert 0.0 < figures.flagged_low < 0.5 < figures.flagged_high < 1.0


def test_a_move_is_noticed_after_other_drives_of_the_same_place() -> None:
    rows = [driven("street", seed, (judged(0.0),) * 5, (judged(1.0),) * 5) for seed in (1, 2)]
    figures = of(rows, "1 deg")
    assert (figures.drives, figures.suspected, figures.confirmed) == (2, 2, 2)
    assert all(2 <= delay <= 4 for delay in figures.delay_checks)


@pytest.mark.parametrize("faint", [(), ("looks",)])
def test_a_place_where_every_check_is_off_alike_alarms_unless_its_edges_are_faint(faint: tuple[str, ...]) -> None:
    good, bad = driven("street", 1, (judged(0.0),) * 5), driven("highway", 2, (judged(1.0, faint=faint),) * 5)
    rendered, resampled = report([good, bad], 1.0).rigs[0].hours
    assert rendered.hours == pytest.approx(10 * check_drives.PERIOD_S / 3600.0)
    assert resampled.hours == pytest.approx(1.0)
    if faint:
        assert resampled.alarms == 0
    else:
        assert resampled.alarms > 0
        assert set(resampled.alarmed) <= {"a highway", "a street"}


def test_same_rows_same_report() -> None:
    rows = [driven("street", seed, (judged(0.0), judged(0.3))) for seed in (1, 2, 3)]
    assert report(rows, 0.2) == report(rows, 0.2)


def test_no_event_bounds_the_mean_at_three_and_more_events_higher() -> None:
    assert poisson_most(0.95, 0) == pytest.approx(3.0, rel=0.03)
    assert poisson_most(0.95, 1) == pytest.approx(4.74, rel=0.03)


def test_rigs_share_the_roads_and_no_road_is_driven_twice() -> None:
    outings = list(check_drives.drives(2))
    assert all(len({(drive.place, drive.seed) for drive in outing}) == 1 for outing in outings)
    drives = [drive for outing in outings for drive in outing]
    assert len({drive.name for drive in drives}) == len(drives)
    seeds = {drive.seed for drive in drives}
    assert len(seeds) == 2 * len(check_drives.PLACES)
    assert not seeds & {seed for _, seed in check_drives.COMMISSIONED_ON}


def test_later_rounds_alone_are_those_that_follow() -> None:
    assert [*check_drives.drives(1), *check_drives.drives(2, first=2)] == list(check_drives.drives(3))
