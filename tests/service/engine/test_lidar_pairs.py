"""Two LiDARs of a running service: looked at by sensor time, told in one order, refused in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.rig.lidar_sampling import LidarRig, RangeBias
from coec.calibration.types import Reason
from coec.geometry import se3
from coec.schemas.message import from_json, to_json
from coec.schemas.rig_state import RigReply
from coec.service.engine.lidar_pairs import COUNTS_AFTER_NS, RESTS, SWEEP_SETS_WAITING, LidarPairStream
from coec.service.worker.worker_jobs import Answer, Cost, Kind, Registered
from support.rigs import LIDAR_POSES, LIDARS, NS, LidarBench, registration, relative_pose, true_registration, with_extra

pytestmark = pytest.mark.usefixtures("with_extra")
__all__ = ["with_extra"]

EDGE = "roof to bumper"
DISPLACED_S = 60.0
TURN = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.0, 0.0])


def displaced(name: str) -> Callable[[LidarRig, int], Answer | Reason]:
    moved = {**LIDAR_POSES, name: se3.perturb(LIDAR_POSES[name], TURN)}

    def answers(rig: LidarRig, stamp_ns: int) -> Answer:
        return registration(rig, relative_pose(moved if stamp_ns >= DISPLACED_S * NS else LIDAR_POSES, rig), stamp_ns)

    return answers


def states(bench: LidarBench) -> dict[str, str]:
    return {sensor.name: sensor.state for sensor in bench.reply.sensors}


def test_every_two_lidars_are_reported_with_their_age_and_uncertainty(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path)
    assert {one.name: one.state for one in bench.reply.lidars} == dict.fromkeys(
        ("roof to bumper", "roof to trunk", "bumper to trunk"), "waiting"
    )
    bench.drive(0.0, 40.0)
    result = bench.reply_between(EDGE)
    assert (result.state, result.looks, result.losses) == ("measured", 2, {})
    assert result.measured_ns == result.stamp_ns == 17 * NS
    assert result.a_from_b is not None
    pose = np.array(result.a_from_b.matrix)
    truth = LIDAR_POSES["roof"] @ se3.inverse(LIDAR_POSES["bumper"])
    assert np.abs(se3.difference(pose, truth)).max() < 0.03
    assert result.sigma is not None
    assert 0.01 < result.sigma[0] < 0.1
    assert bench.reply.looks == dict.fromkeys(("bumper to trunk", "roof to bumper", "roof to trunk"), 2)
    assert from_json(RigReply, to_json(bench.reply)) == bench.reply
    assert {pair for sensor in bench.reply.sensors for pair in sensor.pairs} == {f"front-{name}" for name in LIDARS}


@pytest.mark.fault("a LiDAR is knocked, and no camera sees anything", "the other LiDARs alone name it")
@pytest.mark.parametrize("name", ["roof", "bumper"])
def test_a_displaced_lidar_is_named_by_the_others_alone(
    tmp_path: Path, name: str, record_property: Callable[[str, object], None]
) -> None:
    bench = LidarBench(tmp_path, displaced(name))
    bench.drive(0.0, DISPLACED_S)
    assert {states(bench)[lidar] for lidar in LIDARS} == {"calibrated"}
    at_s = DISPLACED_S
    while states(bench)[name] != "lidar_moved" and at_s < DISPLACED_S + 90.0:
        bench.drive(at_s, at_s + 5.0)
        at_s += 5.0
    reported = states(bench)
    assert {lidar for lidar in LIDARS if reported[lidar] == "lidar_moved"} == {name}
    assert at_s <= DISPLACED_S + 60.0
    record_property("figure", f"{at_s - DISPLACED_S:.0f} s after the knock")


@pytest.mark.fault("sweeps and answers come in another order", "the same reply, to the byte")
def test_another_order_of_arrival_gives_the_same_to_the_byte(tmp_path: Path) -> None:
    reported, requested = set(), set()
    for seed, slow in ((None, 1.0), (1, 0.2), (2, 0.5)):
        bench = LidarBench(tmp_path / str(seed), displaced("bumper"), seed=seed, slow=slow)
        bench.drive(0.0, DISPLACED_S + 45.0)
        bench.slow = 1.0
        bench.settle()
        reported.add(to_json(bench.reply.model_copy(update={"stamp_ns": None})))
        requested.add(tuple(sorted(bench.worker.stamps)))
    assert len(requested) == 1
    assert len(reported) == 1


@pytest.mark.fault("a registration takes long", "the pairs of the vehicle wait for it, and not for ever")
def test_pairs_wait_for_what_counts_by_their_time(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path, slow=0.0)
    bench.drive(0.0, 16.0)
    assert len(bench.worker.waiting) == 3
    bench.drive(16.0, 36.0)
    assert bench.pairs[0].waits(36 * NS)
    bench.slow = 1.0
    bench.settle()
    assert not bench.pairs[0].waits(36 * NS)


@pytest.mark.fault("the worker answers no registration", "a bounded number of sweeps is kept, the rest is counted")
def test_what_waits_is_bounded_and_losses_are_counted(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path, slow=0.0, lidars=("roof", "bumper"))
    bench.drive(0.0, 130.0)
    assert len(bench.worker.waiting) <= 2
    (stream,) = bench.vehicle._receivers.values()
    assert isinstance(stream, LidarPairStream)
    assert len(stream._sweep_sets) <= SWEEP_SETS_WAITING
    bench.slow = 1.0
    bench.drive(130.0, 170.0)
    assert bench.reply_between(EDGE).losses["superseded"] >= 4
    assert bench.reply_between(EDGE).state == "measured"


@pytest.mark.fault("the worker dies of a registration", "the request is refused with words; the next look is taken")
def test_a_worker_that_fails_is_a_reason_and_no_end(tmp_path: Path) -> None:
    failing = Reason("worker_failed", "The worker was ended by signal 9.")

    def answers(rig: LidarRig, stamp_ns: int) -> Answer | Reason:
        return failing if stamp_ns < 20 * NS else true_registration(rig, stamp_ns)

    bench = LidarBench(tmp_path, answers)
    bench.drive(0.0, 30.0)
    result = bench.reply_between(EDGE)
    assert (result.state, [reason.code for reason in result.reasons]) == ("refused", ["worker_failed"])
    bench.drive(30.0, 60.0)
    assert bench.reply_between(EDGE).state == "measured"
    assert bench.reply_between(EDGE).reasons == ()


@pytest.mark.fault("two LiDARs see nothing in common", "this is reported, and tried an eighth as often")
def test_lidars_that_do_not_overlap_are_let_rest(tmp_path: Path) -> None:
    separation = Reason("lidar_overlap", "roof and bumper overlap too little.")

    def answers(rig: LidarRig, stamp_ns: int) -> Answer:
        del stamp_ns
        return Registered(rig.T_a_b_nominal, np.eye(6), RangeBias(0.0, 0.03), float("nan"), 0, 0.0, 2, (separation,))

    bench = LidarBench(tmp_path, answers, lidars=("roof", "bumper"))
    bench.drive(0.0, 15.0 * (2 * RESTS + 5))
    assert bench.reply_between(EDGE).state == "refused"
    observations = [stamp_ns // (15 * NS) for _, stamp_ns in bench.worker.stamps]
    assert observations == [0, RESTS + 1, 2 * RESTS + 2]
    rig = bench.states[-1].rig
    assert rig is not None
    assert EDGE not in rig.graph.edge


@pytest.mark.parametrize(("code", "speed_mps", "timed"), [("vehicle_stands", 0.0, True), ("no_point_time", 8.0, False)])
def test_sweeps_that_are_uninformative_are_refused_as_text(
    tmp_path: Path, code: str, speed_mps: float, timed: bool
) -> None:
    bench = LidarBench(tmp_path)
    bench.drive(0.0, 30.0, speed_mps=speed_mps, timed=timed)
    result = bench.reply_between(EDGE)
    assert (result.state, [reason.code for reason in result.reasons]) == ("refused", [code])
    assert bench.worker.stamps == []
    assert bench.states[-1].rig is not None
    bench.drive(30.0, 60.0)
    assert bench.reply_between(EDGE).state == "measured"


def test_featureless_ground_is_refused_and_weak_directions_are_not_reported(tmp_path: Path) -> None:
    def nothing(rig: LidarRig, stamp_ns: int) -> Answer:
        wide = np.diag([*np.radians([5.0] * 3), 0.5, 0.5, 0.5]) ** 2
        reported = registration(rig, rig.T_a_b_nominal, stamp_ns)
        return Registered(reported.T_a_b, wide, reported.range_bias, 0.02, 2000, 0.3, 2, ())

    bench = LidarBench(tmp_path, nothing)
    bench.drive(0.0, 30.0)
    result = bench.reply_between(EDGE)
    assert [reason.code for reason in result.reasons] == ["surroundings_tell_nothing"]
    assert result.looks == 0


def test_what_cannot_be_afforded_is_reported(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path, lidars=("roof", "bumper"), cores=0.01)
    for _ in range(9):
        bench.budget.pay(Cost(Kind.REGISTER.value, EDGE, 0.6))
    bench.drive(0.0, 120.0)
    share = bench.budget.report().pairs[EDGE]
    assert share.check_s == 0.6
    assert share.active
    assert 1 <= len(bench.worker.stamps) < 8
    assert bench.reply_between(EDGE).losses["not_afforded"] > 0


@pytest.mark.fault("the clock of the sensors steps back", "what was asked before tells nothing after it")
def test_the_clock_of_the_sensors_steps_back(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path, slow=0.0)
    bench.drive(1000.0, 1008.0)
    assert bench.worker.waiting
    bench.drive(0.0, 10.0)
    for pair in bench.pairs:
        pair.time_stepped_back(10 * NS)
    bench.slow = 1.0
    bench.drive(10.0, 50.0)
    result = bench.reply_between(EDGE)
    assert result.losses["time_stepped_back"] == 1
    assert result.measured_ns == 32 * NS
    assert bench.estimator._schedule.taken_ns >= 32 * NS + COUNTS_AFTER_NS


def test_edges_outlive_a_restart_and_a_lidar_that_was_displaced_meanwhile_is_named(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path)
    bench.drive(0.0, DISPLACED_S)
    bench.estimator.finish()
    bench.estimator._disk_writer.write_due()
    again = LidarBench(tmp_path, displaced("bumper"))
    again.drive(DISPLACED_S, DISPLACED_S + 60.0)
    assert states(again)["bumper"] == "lidar_moved"
