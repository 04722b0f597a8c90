"""What the rig has against its pairs, from a knock to its correction: one thing at a time, and nothing before it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.rig_estimator import RigAlarm, misfits, rig_alarms
from coec.service.api.problems import MOVED, SUSPECTED, rig_problems
from support.rigs import LOOPS, TURN, RigDrive, graph, moved_poses

EDGE = "roof-bumper"
RIG = graph([*LOOPS, ("roof", "bumper")])
OF_ROOF = {"front-roof", "left-roof", "rear-roof"}
CAMERAS = tuple(edge.name for edge in RIG.edges if edge.name != EDGE)


def driven() -> RigDrive:
    """Half a minute of a right rig, its LiDARs looked at twice."""
    drive = RigDrive(RIG)
    for _ in range(2):
        drive.add_lidar_check(EDGE, moved_poses())
        drive.add_checks(moved_poses(), 3)
    assert rig_alarms(drive.state) == {}
    return drive


@pytest.mark.fault(
    "a LiDAR is knocked between two looks at it and another",
    "`health` gives one reason at a time, never `inconsistent_rig`",
)
def test_from_the_displacement_to_the_correction_one_thing_is_reported_at_a_time(
    record_property: Callable[[str, object], None],
) -> None:
    drive, after = driven(), moved_poses("roof")
    displaced_s = drive.at_s
    reported: list[dict[str, RigAlarm]] = []

    def note() -> None:
        if not reported or reported[-1] != dict(rig_alarms(drive.state)):
            reported.append(dict(rig_alarms(drive.state)))

    drive.add_lidar_check(EDGE, after)
    note()
    assert not misfits(drive.state), "a look that no other confirms fits no window of before, and is not asked to"
    for turn in range(12):
        drive.add_checks(after, 1)
        note()
        if turn % 3 == 2:
            drive.add_lidar_check(EDGE, after)
            note()
        if drive.state.event is not None:
            break
    assert drive.health()["roof"] is SensorHealth.LIDAR_MOVED
    assert reported[-1] == dict.fromkeys(OF_ROOF, RigAlarm.MOVED)
    named_s = drive.at_s - displaced_s
    texts = rig_problems(drive.state)["front-roof"]
    assert [reason.code for reason in texts] == [MOVED]
    assert texts[0].text.startswith("roof moved")
    drive.add_checks(after, 3)
    for name in sorted(OF_ROOF):
        drive.add_window(name, after, displaced_s + 1.0)
        note()
    drive.add_checks(after, 3)
    drive.add_lidar_check(EDGE, after)
    drive.add_checks(after, 3)
    drive.add_lidar_check(EDGE, after)
    note()
    assert reported[-1] == {}
    assert not any(RigAlarm.INCONSISTENT in one.values() for one in reported), reported
    assert drive.state.correction is not None
    record_property("figure", f"named after {named_s:.0f} s")


def test_one_bad_observation_of_two_lidars_is_held_against_nobody() -> None:
    drive = driven()
    drive.add_lidar_check(EDGE, moved_poses(), TURN)
    assert rig_alarms(drive.state) == {}
    drive.add_checks(moved_poses(), 3)
    drive.add_lidar_check(EDGE, moved_poses())
    assert rig_alarms(drive.state) == {}


@pytest.mark.fault(
    "one of two LiDARs is knocked while no camera sees anything", "either is suspected, without `inconsistent_rig`"
)
def test_while_nothing_determines_which_of_two_moved_it_is_a_suspicion() -> None:
    drive, after = driven(), moved_poses("roof")
    for _ in range(3):
        drive.add_lidar_check(EDGE, after)
        drive.add_checks(after, 3, blind=CAMERAS)
    undecided = {name for name, health in drive.health().items() if health is SensorHealth.UNDECIDED}
    assert {"roof", "bumper"} <= undecided
    assert rig_alarms(drive.state) == {EDGE: RigAlarm.SUSPECTED}, "the pairs fit each other"
    (reason,) = rig_problems(drive.state)[EDGE]
    assert reason.code == SUSPECTED
    assert "bumper or roof" in reason.text or "roof or bumper" in reason.text


def test_windows_that_contradict_each_other_while_nothing_moved_are_inconsistent() -> None:
    drive = driven()
    drive.add_checks(moved_poses(), 6)
    drive.add_window(
        "left-roof", {**moved_poses(), "left": moved_poses("left", xi=3.0 * TURN)["left"]}, drive.at_s - 20.0
    )
    result = rig_alarms(drive.state)
    assert set(np.unique([one.value for one in result.values()])) <= {"inconsistent", "suspected"}
    assert "left-roof" in result
