"""A move of a sensor is one event: named, put right in all of its pairs at once, and over."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coec.calibration.rig import rig_estimator
from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.graph import RigidLink
from coec.calibration.rig.rig_estimator import ServedEdge, misfits
from coec.calibration.types import Matrix4
from coec.geometry import se3
from support.rigs import (
    LOOPS,
    NS,
    POSES,
    SIGMA,
    STAR,
    TURN,
    RigDrive,
    graph,
    known_of,
    moved_poses,
    pose_of,
    windowed_measurement,
)


@pytest.mark.fault("the LiDAR of a rig is knocked by 1°", "one event, one correction for all of its cameras")
def test_a_displaced_lidar_is_put_right_in_all_its_pairs_at_once(
    record_property: Callable[[str, object], None],
) -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 4)
    assert drive.health() == {
        "front": SensorHealth.CALIBRATED,
        "left": SensorHealth.CALIBRATED,
        "rear": SensorHealth.CALIBRATED,
        "roof": SensorHealth.LIDAR_MOVED,
    }
    assert drive.state.correction is None
    for name in ("front-roof", "left-roof"):
        drive.add_window(name, after, displaced_s + 6.0)
    assert drive.state.correction is None
    drive.add_window("rear-roof", after, displaced_s + 6.0)
    correction = drive.state.correction
    assert correction is not None
    assert correction.sensors == ("roof",)
    assert set(correction.pairs) == {"front-roof", "left-roof", "rear-roof"}
    for name, reported in correction.pairs.items():
        away = se3.difference(reported.T_a_b, pose_of(drive.state.graph.edge[name], after))
        assert float(away @ np.linalg.solve(reported.covariance, away)) < 22.5  # 99.9 % of six axes
    drive.add_checks(after, 3)
    assert drive.state.event is None
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}
    assert drive.state.correction is correction
    move = drive.state.move
    assert move is not None
    assert (move.event.sensors, set(move.moved), move.over_ns is not None) == (("roof",), {"roof"}, True)
    record_property("figure", f"{len(correction.pairs)} pairs")


def moves_of_the_lidar(drive: RigDrive) -> list[Matrix4]:
    """As each pair is told it, about the LiDAR's own axes as they were."""
    correction = drive.state.correction
    assert correction is not None
    edges = drive.state.graph.edge
    return [
        np.asarray(se3.inverse(pose_of(edges[name], POSES)) @ reported.T_a_b)
        for name, reported in correction.pairs.items()
    ]


def test_all_pairs_of_a_displaced_lidar_are_reported_nearly_one_move() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 4)
    own = {edge.name: drive.add_window(edge.name, after, displaced_s + 6.0) for edge in drive.state.graph.edges}
    separation = [se3.difference(move, moves_of_the_lidar(drive)[0]) for move in moves_of_the_lidar(drive)[1:]]
    edges = drive.state.graph.edge
    of_windows = [np.asarray(se3.inverse(pose_of(edges[name], POSES)) @ pose) for name, pose in own.items()]
    separation_alone = [se3.difference(move, of_windows[0]) for move in of_windows[1:]]
    assert np.linalg.norm(separation) < 0.5 * np.linalg.norm(separation_alone)
    drive.add_checks(after, 3)
    assert drive.state.event is None
    assert drive.state.before is None, "it is over: what is served now is what is known"
    assert all(one.stamp_ns > round(displaced_s * NS) for of in drive.state.known.values() for one in of)


@pytest.mark.fault("two pairs of a knocked LiDAR tell different moves of it", "`inconsistent_rig`; each keeps its own")
def test_windows_that_report_different_moves_are_put_together_by_nobody() -> None:
    drive, after = RigDrive(graph(STAR[:2])), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 6)
    drive.add_window("front-roof", after, displaced_s + 6.0)
    drive.add_window("left-roof", {**after, "left": moved_poses("left")["left"]}, displaced_s + 6.0)
    assert drive.state.correction is None
    assert set(misfits(drive.state)) == {"front-roof", "left-roof"}


def test_what_was_discovered_of_after_a_displacement_before_it_was_named_is_not_taken_for_before() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 1)
    edge = drive.state.graph.edge["front-roof"]
    result = ServedEdge(pose_of(edge, after), SIGMA, round(displaced_s * NS), known_of(edge, after, drive.at_s))
    drive.state = rig_estimator.after_served(drive.state, edge.name, result, round(drive.at_s * NS))
    drive.add_checks(after, 3)
    before = drive.state.before
    assert before is not None
    assert set(before.edges) == {"front-roof", "left-roof", "rear-roof"}
    for name, one in before.edges.items():
        np.testing.assert_array_equal(one.T_camera_lidar, pose_of(drive.state.graph.edge[name], POSES))
        assert one.stamp_ns < round(displaced_s * NS)


def test_a_pair_whose_two_sensors_both_moved_is_one_that_moved() -> None:
    rig = graph(LOOPS)
    assert rig_estimator.pairs_of(rig, ("front", "roof")) == ("front-bumper", "front-roof", "left-roof", "rear-roof")
    bar = RigidLink("bar", "front", "roof", POSES["front"] @ se3.inverse(POSES["roof"]), np.full(6, 1e-4))
    assert "front-roof" not in rig_estimator.pairs_of(graph(LOOPS, [bar]), ("front", "roof")), "they moved as one"


def test_windows_that_began_before_the_move_put_nothing_right() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 4)
    for edge in drive.state.graph.edges:
        drive.add_window(edge.name, POSES, displaced_s - 20.0)
    assert drive.state.correction is None
    assert drive.health()["roof"] is SensorHealth.LIDAR_MOVED
    assert not drive.state.windows


def test_it_stays_moved_for_as_long_as_a_pair_serves_what_was_before() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 4)
    for edge in drive.state.graph.edges:
        drive.add_window(edge.name, after, displaced_s + 6.0, serves=edge.name != "left-roof")
    assert drive.state.correction is not None
    drive.add_checks(after, 6)
    assert drive.health()["roof"] is SensorHealth.LIDAR_MOVED
    reported = drive.state.correction.pairs["left-roof"]
    served = ServedEdge(reported.T_a_b, SIGMA, round((displaced_s + 6.0) * NS))
    drive.state = rig_estimator.after_served(drive.state, "left-roof", served, round(drive.at_s * NS))
    drive.add_checks(after, 1)
    assert drive.health()["roof"] is SensorHealth.CALIBRATED


@pytest.mark.fault(
    "one camera sees nothing when its LiDAR is knocked", "the others determine where the LiDAR is for its pair"
)
def test_a_pair_that_is_blind_is_not_waited_for_and_reported_by_the_others() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("roof")
    drive.add_checks(POSES, 8)
    drive.add_checks(POSES, 13, blind=("rear-roof",))
    displaced_s = drive.at_s
    drive.add_checks(after, 4, blind=("rear-roof",))
    for name in ("front-roof", "left-roof"):
        drive.add_window(name, after, displaced_s + 6.0)
    assert drive.state.correction is not None
    reported = drive.state.correction.pairs["rear-roof"]
    away = se3.difference(reported.T_a_b, pose_of(drive.state.graph.edge["rear-roof"], after))
    assert float(away @ np.linalg.solve(reported.covariance, away)) < 22.5  # 99.9 % of six axes
    assert np.degrees(np.abs(away[:3]).max()) < 0.2, "of 1°"


@pytest.mark.fault(
    "a camera is knocked by 1°, and its pair puts itself right before looks alone name it", "it is named all the same"
)
def test_a_camera_whose_pair_repairs_itself_at_once_is_named_all_the_same() -> None:
    drive, after = RigDrive(graph(STAR)), moved_poses("front")
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 2)
    assert drive.state.move is None, "looks alone say too little yet"
    edge = drive.state.graph.edge["front-roof"]
    window = windowed_measurement(edge, after, displaced_s, SIGMA)
    drive.state = rig_estimator.after_window(drive.state, edge.name, window, round(drive.at_s * NS))
    assert drive.health()["front"] is SensorHealth.CAMERA_MOVED
    move = drive.state.move
    assert move is not None
    assert move.event.sensors == ("front",)
    assert np.degrees(move.moved["front"].x[:3]) == pytest.approx([0.0, 1.0, 0.0], abs=0.25)
    assert (move.event.stepped_ns, move.over_ns) == (window.start_ns, None)
    served = ServedEdge(window.measurement.T_camera_lidar, SIGMA, window.start_ns)
    drive.state = rig_estimator.after_served(drive.state, edge.name, served, round(drive.at_s * NS))
    drive.add_checks(after, 3)
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}
    assert drive.state.correction is None, "what one pair tells by itself needs nobody to tell it"
    move = drive.state.move
    assert move is not None
    assert move.over_ns == round((drive.at_s - 15.0) * NS), "what was is still told"


def test_a_window_that_observations_of_its_own_time_deny_names_nobody() -> None:
    drive = RigDrive(graph(STAR))
    drive.add_checks(POSES, 8)
    drive.add_window("front-roof", moved_poses("front"), drive.at_s - 20.0, serves=False)
    assert SensorHealth.CAMERA_MOVED not in drive.health().values()
    drive.add_checks(POSES, 4)
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}
    assert drive.state.move is None


def test_what_nobody_can_attribute_is_over_when_its_pair_serves_what_it_discovered() -> None:
    drive, after = RigDrive(graph(STAR[:1])), moved_poses("front", xi=3.0 * TURN)
    drive.add_checks(POSES, 8)
    displaced_s = drive.at_s
    drive.add_checks(after, 4)
    assert set(drive.health().values()) == {SensorHealth.UNDECIDED}
    drive.add_window("front-roof", after, displaced_s + 6.0)
    drive.add_checks(after, 2)
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}


@pytest.mark.fault(
    "a window of one pair of a rig is 1° off", "`inconsistent_rig` for the pairs of its loop; nothing is corrected"
)
def test_a_window_that_does_not_fit_the_others_is_reported_for_the_pairs_of_its_loop() -> None:
    drive = RigDrive(graph(LOOPS))
    drive.add_checks(POSES, 4)
    assert misfits(drive.state) == ()
    edge = drive.state.graph.edge["left-roof"]
    drive.state = rig_estimator.after_window(
        drive.state, edge.name, windowed_measurement(edge, POSES, 5.0, TURN), 20 * NS
    )
    assert set(misfits(drive.state)) == {"front-roof", "left-roof", "front-bumper", "left-bumper"}
    assert drive.state.correction is None


def test_a_first_calibration_far_from_nominal_is_no_move() -> None:
    rig = graph(STAR)
    wide = np.array([np.radians(3.0)] * 3 + [0.2] * 3)
    built = {edge.name: ServedEdge(se3.perturb(pose_of(edge, POSES), TURN), wide, None) for edge in rig.edges}
    drive = RigDrive(rig)
    drive.state = rig_estimator.initial_rig(rig, built, {})
    drive.add_checks(POSES, 6)
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}
    for edge in rig.edges:
        drive.add_window(edge.name, POSES, 10.0)
    drive.add_checks(POSES, 4)
    assert set(drive.health().values()) == {SensorHealth.CALIBRATED}
    assert drive.state.correction is None
