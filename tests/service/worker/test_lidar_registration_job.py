"""The worker registers two LiDARs: sweeps there and the pose back, whatever the clouds hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.rig import nearest_neighbours
from coec.calibration.rig.lidar_sampling import LidarRig, RangeBias, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, Reason, SweepTiming
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.io.converter import structured
from coec.service.worker.job_queue import JobQueue
from coec.service.worker.tasks import Solver, answer_request
from coec.service.worker.worker_jobs import (
    Fate,
    JobOutcome,
    Kind,
    MalformedAnswerError,
    Registered,
    pack_answer,
    read_answer,
    register,
    unpack_sweeps,
    wire_form,
)
from support.vehicles import pair_configuration

T_A_B = se3.perturbation(np.array([0.02, -0.01, 0.4, 0.3, 0.5, -0.4]))
RIG = LidarRig("roof", "bumper", T_A_B, np.eye(4), None, SweepTiming(0.1, -1, 0.5))
MOTION = EgoMotion(0, "ego", (5.0, 0.0, 0.0), (0.0, 0.0, 0.1))


def room(count: int, seed: int) -> np.ndarray:
    """(N, 3) on a floor and three walls about a."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(-4, 4, count), rng.uniform(-3, 3, count), rng.uniform(-1.5, 1.5, count)
    floor, end = (x, y, np.full(count, -1.5)), (np.full(count, 4.0), y, z)
    sides = [(x, np.full(count, at), z) for at in (3.0, -3.0)]
    return np.choose(rng.integers(0, 4, count)[:, None], [np.column_stack(face) for face in (floor, *sides, end)])


def sweeps(points_b: np.ndarray | None = None) -> SweepPair:
    seen = room(1500, 2)
    b = (se3.inverse(T_A_B)[:3, :3] @ seen.T).T + se3.inverse(T_A_B)[:3, 3] if points_b is None else points_b
    times = np.zeros(len(b), np.float32)
    a = LidarFrame(0, "lidar", room(6000, 1).astype(np.float32), time_offset_s=np.zeros(6000, np.float32))
    return SweepPair(a, LidarFrame(0, "lidar", b.astype(np.float32), time_offset_s=times), None)


def question(*pairs: SweepPair) -> dict[str, Any]:
    job = register("roof to bumper", RIG, pairs, lambda _: None)
    frames = [job.body["frames"][place] for place in range(len(pairs))]
    return {"id": 3, "kind": job.kind.value, "pair": job.pair, "lidars": job.body["lidars"], "frames": frames}


@pytest.fixture(scope="module")
def solver() -> Solver:
    return Solver(pair_configuration(Path("state")), 1)


def test_a_question_carries_both_lidars_and_their_sweeps() -> None:
    pair = replace(sweeps(), motion=MOTION)
    requested = question(pair, sweeps())
    result = unpack_sweeps(requested["frames"], LimitsConfig())
    np.testing.assert_array_equal(result[0].b.xyz_m, pair.b.xyz_m)
    assert (result[0].motion, result[1].motion) == (MOTION, None)
    rig = structured(wire_form(), requested["lidars"], LidarRig)
    np.testing.assert_array_equal(rig.T_a_b_nominal, T_A_B)
    assert (rig.a, rig.b, rig.sweep_a, rig.sweep_b) == ("roof", "bumper", None, RIG.sweep_b)


def test_the_worker_finds_the_pose(solver: Solver) -> None:
    pytest.importorskip("small_gicp", reason="the extra `lidars` is not installed")
    result = read_answer(answer_request(solver, question(sweeps())), Kind.REGISTER)
    assert isinstance(result, Registered)
    assert result.reasons == ()
    assert np.abs(se3.difference(result.T_a_b, T_A_B)).max() < 0.02


HOSTILE = {
    "empty": np.empty((0, 3)),
    "one point": np.ones((1, 3)),
    "the same point": np.ones((3000, 3)),
    "a line": np.linspace([1.0, 0.0, 0.0], [50.0, 0.0, 0.0], 3000),
    "far away": room(2000, 3) + 1e6,
    "beyond all": np.full((500, 3), 3e38),
    "at the origin": np.zeros((500, 3)),
}


@pytest.mark.fault("a cloud that no LiDAR would send", "an answer without a pose that counts, and no end of the worker")
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_clouds_are_answered(solver: Solver, name: str) -> None:
    pytest.importorskip("small_gicp", reason="the extra `lidars` is not installed")
    with np.errstate(over="ignore"):
        for pair in (sweeps(HOSTILE[name]), replace(sweeps(), a=sweeps(HOSTILE[name]).b)):
            result = read_answer(answer_request(solver, question(pair)), Kind.REGISTER)
            assert isinstance(result, Registered | Reason)
            assert isinstance(result, Reason) or result.reasons


def test_without_the_extra_the_answer_says_what_to_install(solver: Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nearest_neighbours, "installed", lambda: False)
    result = read_answer(answer_request(solver, question(sweeps())), Kind.REGISTER)
    assert isinstance(result, Reason)
    assert "extra `lidars`" in result.text


GOOD = Registered(T_A_B, np.eye(6) / 7, RangeBias(0.01, 0.002), float("nan"), 700, 0.3, 2, (Reason("a", "b"),))


def test_an_answer_comes_back_to_the_bit() -> None:
    result = read_answer(pack_answer(1, GOOD), Kind.REGISTER)
    assert isinstance(result, Registered)
    np.testing.assert_array_equal(result.T_a_b, GOOD.T_a_b)
    np.testing.assert_array_equal(result.covariance, GOOD.covariance)
    bias = result.range_bias
    assert (bias.longer_m, bias.sigma_m, result.points, result.reasons) == (0.01, 0.002, 700, GOOD.reasons)


@pytest.mark.parametrize(
    "bad",
    [
        replace(GOOD, T_a_b=np.ones((4, 4))),
        replace(GOOD, T_a_b=np.eye(3)),
        replace(GOOD, covariance=np.full((6, 6), np.nan)),
        replace(GOOD, covariance=np.eye(5)),
    ],
)
def test_an_answer_that_is_none_is_refused(bad: Registered) -> None:
    with pytest.raises(MalformedAnswerError):
        read_answer(pack_answer(1, bad), Kind.REGISTER)


@pytest.mark.fault(
    "the worker is killed while it registers two LiDARs", "answered once, with the reason; windows go on"
)
def test_a_worker_that_is_killed_ends_the_registration() -> None:
    finished: list[JobOutcome] = []
    queue = JobQueue(attempts=2)
    queue.submit(register("roof to bumper", RIG, [sweeps()], finished.append), 0.0)
    assert queue.take(0.0) is not None
    queue.sent(0.0)
    queue.died("was ended by signal 9", 1.0)
    ((job, outcome),) = queue.drain()
    assert (job.kind, outcome.fate) == (Kind.REGISTER, Fate.FAILED)
    assert outcome.reason is not None
    assert "signal 9" in outcome.reason.text
    assert queue.take(2.0) is None
