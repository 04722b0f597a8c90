"""Who moved: the sensor that explains it with fewest moves is named, and nobody where that cannot be told."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.rig.attribution import (
    NAMED_AT,
    RigState,
    SensorHealth,
    after_edge_observation,
    after_window,
    initial,
    sensors,
    served,
)
from coec.calibration.rig.edge_observations import information_of, observation_of_window
from coec.calibration.rig.graph import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry import se3
from support.rigs import NS, PLACE, POSES, SIGMA, TURN, checked_rig, edge_check, graph, moved_poses

STAR = (("front", "roof"), ("left", "roof"), ("rear", "roof"))
MOVED = {SensorHealth.CAMERA_MOVED, SensorHealth.LIDAR_MOVED}


def _health(state: RigState, rig: RigGraph) -> dict[str, SensorHealth]:
    return {sensor.name: sensor.health for sensor in sensors(state, rig)}


def _named(state: RigState, rig: RigGraph) -> set[str]:
    return {name for name, health in _health(state, rig).items() if health in MOVED}


@pytest.mark.fault(
    "sensors of a rig are knocked by 1°", "they are named after five looks of each pair, and no other is"
)
@pytest.mark.parametrize("who", [("front",), ("roof",), ("front", "rear")])
def test_those_that_moved_are_named_and_reported_by_how_much(
    who: tuple[str, ...], record_property: Callable[[str, object], None]
) -> None:
    rig = graph(STAR)
    state = checked_rig(rig, POSES, moved_poses(*who))
    assert _named(state, rig) == set(who)
    assert all(health is SensorHealth.CALIBRATED for name, health in _health(state, rig).items() if name not in who)
    for sensor in sensors(state, rig):
        if sensor.name in who:
            assert sensor.moved is not None
            away = sensor.moved.x - TURN
            assert float(away @ np.linalg.solve(sensor.moved.covariance, away)) < 22.5  # 99.9 % of six axes
    record_property("figure", f"{min(s.probability for s in sensors(state, rig) if s.name in who):.3f}")


@pytest.mark.parametrize("who", [("roof",), ("front", "rear")])
def test_a_sensor_is_named_by_the_second_answer_that_knows_of_a_new_observation_of_it(who: tuple[str, ...]) -> None:
    rig = graph(STAR)
    state, after, rng = checked_rig(rig, POSES, POSES, rounds=(4, 0)), moved_poses(*who), np.random.default_rng(7)
    requested: list[RigState] = []
    for turn in range(4, 12):
        for place, edge in enumerate(rig.edges):
            before, at_s = state, 5.0 * turn + 0.5 * place
            state = after_edge_observation(state, rig, edge_check(edge, after, at_s, SIGMA * rng.normal(size=6)))
            if state.attributed_ns != before.attributed_ns:
                requested.append(state)
    probable = [set(who) <= {name for name, p in one.posterior.sensors.items() if p >= NAMED_AT}
                for one in requested if one.posterior is not None]  # fmt: skip
    first_reported, first_named = probable.index(True), [one.named for one in requested].index(frozenset(who))
    assert first_named > first_reported, "one answer is none"
    assert all(one.named <= set(who) for one in requested)


@pytest.mark.fault(
    "biased looks at one pair of a LiDAR that was knocked",
    "its camera is not named beside the LiDAR, unless its own window says so",
)
def test_a_camera_next_to_its_one_lidar_is_named_by_a_window_and_not_by_observations() -> None:
    rig = graph(STAR)
    after = moved_poses("front", "roof")
    state = checked_rig(rig, POSES, after, rounds=(4, 12))
    assert _named(state, rig) == {"roof"}
    (front,) = (sensor for sensor in sensors(state, rig) if sensor.name == "front")
    assert front.health is SensorHealth.UNDECIDED
    assert front.reasons[0].text.endswith("a window of its pairs decides.")
    window = edge_check(rig.edges[0], after, 100.0, np.zeros(6))
    assert _named(after_window(state, rig, window), rig) == {"front", "roof"}


BENT = np.array([radians(0.35), 0.0, radians(-0.3), 0.0, 0.0, 0.0])
"""What looks of a poor street may be off by, all alike."""


def test_a_window_that_denies_bent_observations_keeps_a_camera_from_being_named_next_to_its_lidar() -> None:
    rig, rng = graph(STAR), np.random.default_rng(5)
    after, bent = moved_poses("roof"), {**moved_poses("roof"), "front": se3.perturb(POSES["front"], BENT)}
    state = checked_rig(rig, POSES, POSES, rounds=(4, 0))
    for turn in range(4, 14):
        for place, edge in enumerate(rig.edges):
            error = SIGMA * rng.normal(size=6)
            state = after_edge_observation(state, rig, edge_check(edge, bent, 5.0 * turn + 0.5 * place, error))
    assert state.posterior is not None
    assert state.posterior.sensors["front"] >= NAMED_AT, "by looks it would be"
    window = edge_check(rig.edges[0], after, 50.0, np.zeros(6))
    assert _named(after_window(state, rig, window), rig) == {"roof"}


def _checked_at(after: Mapping[str, Matrix4], suspicious: Collection[int]) -> set[str]:
    """Who is named after ten rounds of looks at the star, of which the front camera's suspect a move in some."""
    rig, rng = graph(STAR), np.random.default_rng(9)
    state = checked_rig(rig, POSES, POSES, rounds=(4, 0))
    for turn in range(4, 14):
        for place, edge in enumerate(rig.edges):
            seen = edge_check(edge, after, 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            stepped_ns = seen.stamp_ns if edge.a == "front" and turn in suspicious else None
            state = after_edge_observation(state, rig, replace(seen, stepped_ns=stepped_ns))
    return _named(state, rig)


@pytest.mark.fault(
    "a street biases all looks at a pair a little",
    "its camera is not named unless the pair suspects a move, and still does",
)
def test_a_camera_whose_only_pair_suspects_nothing_is_not_named() -> None:
    bent = {**POSES, "front": se3.perturb(POSES["front"], BENT)}
    assert _checked_at(bent, range(4, 14)) == {"front"}
    assert _checked_at(bent, ()) == set()
    assert _checked_at(bent, (5,)) == set(), "a single bad look that the next ones deny"


def test_a_camera_that_stepped_farther_than_streets_bend_is_named_though_its_pair_suspects_nothing() -> None:
    """What is served was a little off, and the knock went across it."""
    assert _checked_at(moved_poses("front"), ()) == {"front"}


FAINT = 40.0
"""Information of faint looks: so many times less."""


def _few_observations_before(offset: np.ndarray) -> RigState:
    """A star whose served poses windows told. The front camera's pair was looked at faintly before it moved by an
    offset, and clearly after it: not clearly enough against a bias of its looks."""
    rig, rng = graph(STAR), np.random.default_rng(3)
    state = initial(rig)
    for edge in rig.edges:
        state = served(state, edge.name, edge.T_a_b, SIGMA)
    after = {**POSES, "front": se3.perturb(POSES["front"], offset)}
    for turn in range(12):
        for place, edge in enumerate(rig.edges):
            poses = POSES if turn < 3 else after
            seen = edge_check(edge, poses, 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            if turn < 3:
                seen = replace(seen, information=seen.information / FAINT, weak=True)
            state = after_edge_observation(state, rig, seen)
    return state


@pytest.mark.fault(
    "a camera is knocked before a clear look at it, so its looks may be biased",
    "undecided by looks; an accepted window of its pair, compared with the windows of before, names it",
)
def test_a_window_compared_with_earlier_windows_reports_what_biased_observations_cannot() -> None:
    rig, offset = graph(STAR), 0.6 * TURN
    state = _few_observations_before(offset)
    assert _named(state, rig) == set()
    edge = rig.edges[0]
    after = {**POSES, "front": se3.perturb(POSES["front"], offset)}
    measured = Measurement(after["front"] @ se3.inverse(POSES["roof"]), Uncertainty.independent(SIGMA), 40 * NS)
    window = observation_of_window(edge.name, measured)
    assert window is not None
    assert _named(after_window(state, rig, window), rig) == {"front"}
    denies = observation_of_window(edge.name, replace(measured, T_camera_lidar=edge.T_a_b))
    assert denies is not None
    denied = after_window(state, rig, denies)
    assert _named(denied, rig) == set()
    assert denied.posterior is not None
    assert denied.posterior.sensors["front"] < 0.5


def test_a_window_of_before_the_step_is_no_answer() -> None:
    rig = graph(STAR)
    state = checked_rig(rig, POSES, moved_poses("front", "roof"), rounds=(4, 12))
    window = edge_check(rig.edges[0], POSES, 17.0, np.zeros(6))
    assert _named(after_window(state, rig, window), rig) == {"roof"}


@pytest.mark.fault("bad looks at a camera, then no new look at it", "looks at other sensors do not name the camera")
def test_an_answer_without_a_new_observation_of_a_sensor_is_none() -> None:
    rig, rng = graph(STAR), np.random.default_rng(3)
    state = checked_rig(rig, POSES, POSES, rounds=(6, 0))
    front, *others = rig.edges
    for turn in range(3):
        state = after_edge_observation(
            state, rig, edge_check(front, moved_poses("front"), 30.0 + turn, SIGMA * rng.normal(size=6))
        )
    for turn in range(6):
        for place, edge in enumerate(others):
            error = SIGMA * rng.normal(size=6)
            state = after_edge_observation(state, rig, edge_check(edge, POSES, 35.0 + 5.0 * turn + 0.5 * place, error))
    assert state.posterior is not None
    assert state.posterior.sensors["front"] >= NAMED_AT
    assert not _named(state, rig)
    state = after_edge_observation(
        state, rig, edge_check(front, moved_poses("front"), 70.0, SIGMA * rng.normal(size=6))
    )
    assert _named(state, rig) == {"front"}


def test_nothing_happened_and_nobody_is_named() -> None:
    rig = graph(STAR)
    assert set(_health(checked_rig(rig, POSES, POSES), rig).values()) == {SensorHealth.CALIBRATED}


def test_before_the_first_observation_nothing_is_known() -> None:
    rig = graph(STAR)
    assert set(_health(initial(rig), rig).values()) == {SensorHealth.UNKNOWN}


@pytest.mark.parametrize("who", ["front", "roof"])
def test_one_camera_and_one_lidar_are_undecided_whoever_moved(who: str) -> None:
    rig = graph([("front", "roof")])
    state = checked_rig(rig, POSES, moved_poses(who, xi=np.array([0.0, 0.15, 0.0, 0.0, 0.0, 0.0])))
    assert set(_health(state, rig).values()) == {SensorHealth.UNDECIDED}
    probabilities = [sensor.probability for sensor in sensors(state, rig)]
    assert probabilities[0] == pytest.approx(probabilities[1], abs=1e-12)
    assert 0.4 < probabilities[0] <= 0.5
    reasons = [reason.text for sensor in sensors(state, rig) for reason in sensor.reasons]
    assert "roof" in reasons[0]
    assert "front" in reasons[1]


def test_two_of_three_that_moved_are_not_distinguished_from_the_other_two() -> None:
    rig = graph(STAR[:2])
    after = {**moved_poses("front"), "left": moved_poses("left", xi=-2.0 * TURN)["left"]}
    state = checked_rig(rig, POSES, after)
    assert not _named(state, rig)
    assert SensorHealth.UNDECIDED in _health(state, rig).values()


@pytest.mark.fault("one pair of a rig is disturbed, its sensors stand still", "no sensor is named, the pair is")
def test_a_pair_that_others_contradict_is_disturbed_and_its_sensors_undecided() -> None:
    rig = graph([*STAR[:2], ("front", "bumper"), ("left", "bumper")])
    rng, state = np.random.default_rng(3), initial(rig)
    for turn in range(14):
        for place, edge in enumerate(rig.edges):
            error = SIGMA * rng.normal(size=6) + (TURN if edge.name == "front-roof" and turn >= 8 else 0.0)
            state = after_edge_observation(state, rig, edge_check(edge, POSES, 5.0 * turn + 0.3 * place, error))
    assert not _named(state, rig)
    assert state.posterior is not None
    assert state.posterior.disturbed["front-roof"] > 0.9
    undecided = {name for name, health in _health(state, rig).items() if health is SensorHealth.UNDECIDED}
    assert undecided == {"front", "roof"}


def test_a_bar_that_was_displaced_is_one_move_of_all_on_it() -> None:
    rigid = RigidLink("bar", "front", "left", POSES["front"] @ se3.inverse(POSES["left"]), np.full(6, 1e-4))
    rig = graph(STAR, [rigid])
    T_front_rig = se3.perturb(POSES["front"], TURN)
    after = {**POSES, "front": T_front_rig, "left": se3.inverse(rigid.T_a_b) @ T_front_rig}
    assert _named(checked_rig(rig, POSES, after), rig) == {"front", "left"}


def test_a_pose_that_is_served_anew_settles_the_event() -> None:
    rig, after = graph(STAR), moved_poses("front")
    state = checked_rig(rig, POSES, after)
    pose = after["front"] @ se3.inverse(after["roof"])
    state = served(state, "front-roof", pose, np.full(6, 1e-3))
    rng = np.random.default_rng(9)
    for turn in range(3):
        for place, edge in enumerate(rig.edges):
            state = after_edge_observation(
                state, rig, edge_check(edge, after, 100.0 + 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            )
    assert set(_health(state, rig).values()) == {SensorHealth.CALIBRATED}


def test_names_and_the_order_in_which_a_rig_is_given_change_nothing() -> None:
    other = {"front": "z", "left": "m", "rear": "a", "roof": "k", "bumper": "b"}
    rig, after = graph(STAR), moved_poses("roof")
    renamed = RigGraph.of(
        [Sensor(other[sensor.name], sensor.kind) for sensor in reversed(rig.sensors)],
        [Edge(f"e{edge.name}", other[edge.a], other[edge.b], edge.T_a_b) for edge in reversed(rig.edges)],
    )
    state, twin = initial(rig), initial(renamed)
    rng = np.random.default_rng(2)
    for turn in range(12):
        for place, edge in enumerate(rig.edges):
            seen = edge_check(edge, POSES if turn < 8 else after, 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            state = after_edge_observation(state, rig, seen)
            twin = after_edge_observation(twin, renamed, replace(seen, edge=f"e{edge.name}"))
    mine = {other[sensor.name]: sensor.probability for sensor in sensors(state, rig)}
    theirs = {sensor.name: sensor.probability for sensor in sensors(twin, renamed)}
    assert mine == pytest.approx(theirs, abs=1e-9)


def test_it_replays_to_the_byte() -> None:
    rig = graph(STAR)
    one, two = (checked_rig(rig, POSES, moved_poses("front")) for _ in range(2))
    assert one.posterior is not None
    assert two.posterior is not None
    assert one.posterior.sensors == two.posterior.sensors
    assert one.posterior.steps["front"].x.tobytes() == two.posterior.steps["front"].x.tobytes()


@pytest.mark.fault(
    "a covariance of a rig's evidence that is NaN, singular or absurd", "it is refused with its reason, no traceback"
)
@pytest.mark.parametrize(
    "covariance",
    [
        np.full((6, 6), np.nan),
        np.zeros((6, 6)),
        np.diag([1e-6, 1e-6, -1e-6, 1e-4, 1e-4, 1e-4]),
        np.ones((6, 6)),
        np.diag(np.full(6, 1e300)),
        np.diag(np.full(6, 1e-300)),
        np.eye(5),
        np.triu(np.full((6, 6), 1e-4)),
    ],
)
def test_evidence_that_is_none_is_refused(covariance: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"covariance|positive definite"):
        information_of(covariance)


def test_a_rig_that_is_none_is_refused() -> None:
    sensor, pose = Sensor("a", SensorKind.CAMERA), np.eye(4)
    with pytest.raises(ValueError, match="1 to 12 sensors"):
        RigGraph.of([], [])
    with pytest.raises(ValueError, match="duplicates"):
        RigGraph.of([sensor, sensor], [])
    with pytest.raises(ValueError, match="not two different sensors"):
        RigGraph.of([sensor], [Edge("e", "a", "b", pose)])
    with pytest.raises(ValueError, match="rigid"):
        RigGraph.of([sensor, Sensor("b", SensorKind.LIDAR)], [Edge("e", "a", "b", np.full((4, 4), np.nan))])
    with pytest.raises(ValueError, match="six positive"):
        graph([("front", "roof")], [RigidLink("l", "front", "roof", pose, np.zeros(6))])
    with pytest.raises(ValueError, match="not an edge of this rig"):
        served(initial(graph(STAR)), "other", pose, PLACE)
