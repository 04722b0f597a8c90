"""What the rig has against its pairs, from a knock to its correction: one thing at a time, and nothing before it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.objections import Objection, misfits, objections
from coec.runtime.api.rig_troubles import MOVED, SUSPECTED, troubles_of
from driven_rig import LOOPS, Drive
from rigs import TURN, graph, with_moved

EDGE = "roof-bumper"
RIG = graph([*LOOPS, ("roof", "bumper")])
OF_ROOF = {"front-roof", "left-roof", "rear-roof"}
CAMERAS = tuple(edge.name for edge in RIG.edges if edge.name != EDGE)


def driven() -> Drive:
    """Half a minute of a right rig, its LiDARs looked at twice."""
    drive = Drive(RIG)
    for _ in range(2):
        drive.lidars(EDGE, with_moved())
        drive.looks(with_moved(), 3)
    assert objections(drive.state) == {}
    return drive


@pytest.mark.fault(
    "a LiDAR is knocked between two looks at it and another",
    "`health` gives one reason at a time, never `inconsistent_rig`",
)
def test_from_the_knock_to_the_correction_one_thing_is_said_at_a_time(
    record_property: Callable[[str, object], None],
) -> None:
    drive, after = driven(), with_moved("roof")
    knocked_s = drive.at_s
    said: list[dict[str, Objection]] = []

    def note() -> None:
        if not said or said[-1] != dict(objections(drive.state)):
            said.append(dict(objections(drive.state)))

    drive.lidars(EDGE, after)
    note()
    assert not misfits(drive.state), "a look that no other confirms fits no window of before, and is not asked to"
    for turn in range(12):
        drive.looks(after, 1)
        note()
        if turn % 3 == 2:
            drive.lidars(EDGE, after)
            note()
        if drive.state.event is not None:
            break
    assert drive.health()["roof"] is SensorHealth.LIDAR_MOVED
    assert said[-1] == dict.fromkeys(OF_ROOF, Objection.MOVED)
    named_s = drive.at_s - knocked_s
    texts = troubles_of(drive.state)["front-roof"]
    assert [reason.code for reason in texts] == [MOVED]
    assert texts[0].text.startswith("roof moved")
    drive.looks(after, 3)
    for name in sorted(OF_ROOF):
        drive.window(name, after, knocked_s + 1.0)
        note()
    drive.looks(after, 3)
    drive.lidars(EDGE, after)
    drive.looks(after, 3)
    drive.lidars(EDGE, after)
    note()
    assert said[-1] == {}
    assert not any(Objection.INCONSISTENT in one.values() for one in said), said
    assert drive.state.correction is not None
    record_property("figure", f"named after {named_s:.0f} s")


def test_one_bad_look_at_two_lidars_is_held_against_nobody() -> None:
    drive = driven()
    drive.lidars(EDGE, with_moved(), TURN)
    assert objections(drive.state) == {}
    drive.looks(with_moved(), 3)
    drive.lidars(EDGE, with_moved())
    assert objections(drive.state) == {}


@pytest.mark.fault(
    "one of two LiDARs is knocked while no camera sees anything", "either is suspected, without `inconsistent_rig`"
)
def test_while_nothing_tells_which_of_two_moved_it_is_a_suspicion() -> None:
    drive, after = driven(), with_moved("roof")
    for _ in range(3):
        drive.lidars(EDGE, after)
        drive.looks(after, 3, blind=CAMERAS)
    undecided = {name for name, health in drive.health().items() if health is SensorHealth.UNDECIDED}
    assert {"roof", "bumper"} <= undecided
    assert objections(drive.state) == {EDGE: Objection.SUSPECTED}, "the pairs fit each other"
    (reason,) = troubles_of(drive.state)[EDGE]
    assert reason.code == SUSPECTED
    assert "bumper or roof" in reason.text or "roof or bumper" in reason.text


def test_windows_that_contradict_each_other_while_nothing_moved_are_inconsistent() -> None:
    drive = driven()
    drive.looks(with_moved(), 6)
    drive.window("left-roof", {**with_moved(), "left": with_moved("left", xi=3.0 * TURN)["left"]}, drive.at_s - 20.0)
    found = objections(drive.state)
    assert set(np.unique([one.value for one in found.values()])) <= {"inconsistent", "suspected"}
    assert "left-roof" in found
