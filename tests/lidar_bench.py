"""LiDARs of a vehicle without threads, sensors or a worker process: who is asked knows where they sit."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from coec.adapters.files.scribe import DiskWriter
from coec.adapters.registration import nearest
from coec.calibration.lidar_to_lidar.types import LidarRig, RangeBias
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4, Reason
from coec.config import BudgetConfig, LidarEdgesConfig, LimitsConfig, PairConfig
from coec.geometry import se3
from coec.runtime.api.rig import reply_of
from coec.runtime.budget.budget import Budget
from coec.runtime.edges.all import LidarPairs
from coec.runtime.ingest.decoder import EGO, Frame
from coec.runtime.ingest.intake import Intake
from coec.runtime.rig.keeper import RigEstimatorThread, RigSnapshot
from coec.runtime.rig.pair_side import RigMember
from coec.runtime.worker.jobs import Answer, Fate, JobOutcome, Registered, WorkerJob
from coec.runtime.worker.messages import unpack_lidars, unpack_sweeps
from coec.runtime.worker.supervisor import Worker
from coec.schemas.rig_state import LidarsReply, RigReply
from pair_bench import pair_configuration
from rig_said import pair_state
from rigs import NS, POSES

LIDARS = ("roof", "bumper", "trunk")
LIDAR_POSES: Mapping[str, Matrix4] = {
    **POSES,
    "trunk": se3.exp(np.array([0.0, 0.1, 2.8, -1.0, 0.7, -0.7])),
}
"""T_sensor_rig (4, 4)."""
LIDAR_SIGMA = np.array([*np.radians([0.03] * 3), 0.006, 0.006, 0.006])
MORE_LATE_S = 0.4
"""By which frames of one stream come after those of others, at most."""


def lidar_pair(lidar: str, *, ego: bool = True) -> PairConfig:
    """The front camera and a LiDAR."""
    pair = pair_configuration(Path("state")).pairs[0]
    camera = pair.camera.model_copy(update={"name": "front", "key": "in/front"})
    of = pair.lidar.model_copy(update={"name": lidar, "key": f"in/{lidar}", "frame_id": "lidar"})
    nominal = (LIDAR_POSES["front"] @ se3.inverse(LIDAR_POSES[lidar])).tolist()
    update = {"name": f"front-{lidar}", "camera": camera, "lidar": of, "T_camera_lidar": nominal}
    return pair.model_copy(update=update if ego else {**update, "ego": None})


Answers = Callable[[LidarRig, int], Answer | Reason]


@dataclass
class FakeLidarWorker:
    """Stands for the worker: what it is asked waits until `answer` is called."""

    answers: Answers
    waiting: list[WorkerJob] = field(default_factory=list)
    stamps: list[tuple[str, int]] = field(default_factory=list)

    def submit(self, job: WorkerJob) -> None:
        sweeps = unpack_sweeps(job.body["frames"], LimitsConfig())
        self.stamps.append((job.pair, sweeps[-1].a.stamp_ns))
        self.waiting.append(job)

    def answer(self, job: WorkerJob) -> None:
        self.waiting.remove(job)
        result = self.answers(
            unpack_lidars(job.body["lidars"]), unpack_sweeps(job.body["frames"], LimitsConfig())[-1].a.stamp_ns
        )
        reason = result if isinstance(result, Reason) else None
        answer = None if isinstance(result, Reason) else result
        job.done(JobOutcome(Fate.RESULT if reason is None else Fate.FAILED, answer, reason, 0.1))


def registration(rig: LidarRig, T_a_b: Matrix4, stamp_ns: int) -> Registered:
    """What a registration near a pose (4, 4) tells: its errors are drawn from its stamp."""
    rng = np.random.default_rng([stamp_ns // 1000, *rig.b.encode()])
    pose = se3.perturb(T_a_b, LIDAR_SIGMA * rng.normal(size=6))
    return Registered(pose, np.diag(LIDAR_SIGMA**2), RangeBias(0.01, 0.005), 0.02, 2000, 0.3, 2, ())


def relative_pose(poses: Mapping[str, Matrix4], rig: LidarRig) -> Matrix4:
    """T_a_b (4, 4)."""
    return np.asarray(poses[rig.a] @ se3.inverse(poses[rig.b]))


def true_registration(rig: LidarRig, stamp_ns: int) -> Answer | Reason:
    """Of mounts that stay."""
    return registration(rig, relative_pose(LIDAR_POSES, rig), stamp_ns)


class LidarBench:
    """Streams of LiDARs and of ego-motion, at 5 Hz while looks are taken of a period of 15 s, in an order that a seed
    draws: what comes late comes at most `MORE_LATE_S` late; answers come in any order. Pairs of cameras say nothing.

    Attributes:
        slow: share of the questions that wait at each step and are answered then.
    """

    def __init__(
        self, folder: Path, answers: Answers = true_registration, *, seed: int | None = None, period_s: float = 15.0,
        lidars: tuple[str, ...] = LIDARS, cores: float = 64.0, slow: float = 1.0, ego: bool = True,
    ) -> None:  # fmt: skip
        self.rng = random.Random(seed)
        self.late_s = 0.0 if seed is None else MORE_LATE_S
        self.slow = slow
        self.intake = Intake(LimitsConfig())
        self.estimator = RigEstimatorThread(folder, (), DiskWriter(folder))
        self.worker = FakeLidarWorker(answers)
        self.budget = Budget(BudgetConfig(cores=cores), lambda: 0.0)
        self.states: list[RigSnapshot] = []
        self.ego = ego
        self.pairs: list[RigMember] = []
        configs = [self.join(lidar) for lidar in lidars]
        worker = cast("Worker", self.worker)
        self.edges = LidarPairs(LidarEdgesConfig(period_s=period_s), self.intake, worker, self.budget, self.estimator)
        self.edges.grow(configs)
        self.estimator.connect(self.states.append, lambda: None)
        self.settle()

    def join(self, lidar: str) -> PairConfig:
        """A pair of it becomes one of the rig."""
        config = lidar_pair(lidar, ego=self.ego)
        self.intake.sensors_of(config)
        self.pairs.append(
            self.estimator.join(config, np.array(config.T_camera_lidar), pair_state("front"), lambda: True)
        )
        return config

    def drive(self, begin_s: float, end_s: float, *, speed_mps: float = 8.0, timed: bool = True) -> None:
        """Frames of this stretch of sensor time, and what becomes of them."""
        arrivals = []
        for stream in (*LIDARS, EGO):
            late_s = self.rng.uniform(0.0, self.late_s)
            for tick in range(round(begin_s * 5), round(end_s * 5)):
                if tick % 75 > 17 and tick % 10:
                    continue  # nobody looks at them
                stamp_ns = tick * NS // 5 + 13_000_000 * (*LIDARS, EGO).index(stream)
                arrivals.append((stamp_ns / NS + late_s, stream, stamp_ns))
        for _, stream, stamp_ns in sorted(arrivals):
            self.push(stream, lidar_frame(stream, stamp_ns, speed_mps, timed=timed))
            if stream == LIDARS[0]:
                for pair in self.pairs:
                    pair.must_wait(stamp_ns, for_own=False)
                self.settle()
        self.settle()

    def push(self, stream: str, frame: Frame) -> None:
        """A frame came."""
        for sensor in self.intake.sensors:
            if sensor.config.sensor in (stream, f"in/{stream}"):
                for taker in sensor.takers:
                    taker(frame)

    def settle(self) -> None:
        """What the threads do until there is nothing more that they may do."""
        self.answer_some()
        while self.intake.turn(0.0) or self.estimator.work(0.0):
            pass

    def answer_some(self) -> None:
        """The worker works."""
        for job in self.rng.sample(self.worker.waiting, len(self.worker.waiting)):
            if self.slow == 1.0 or self.rng.random() < self.slow:
                self.worker.answer(job)

    @property
    def reply(self) -> RigReply:
        return reply_of("vehicle", self.states[-1])

    def reply_between(self, name: str) -> LidarsReply:
        """What is told of two LiDARs."""
        (match,) = [one for one in self.reply.lidars if one.name == name]
        return match


def lidar_frame(stream: str, stamp_ns: int, speed_mps: float, *, timed: bool) -> Frame:
    if stream == EGO:
        return EgoMotion(stamp_ns, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, 0.0))
    points = np.array([[10.0, 0.0, 0.0], [20.0, 1.0, 0.5]], dtype=np.float32)
    return LidarFrame(stamp_ns, "lidar", points, time_offset_s=np.zeros(2, np.float32) if timed else None)


@pytest.fixture
def with_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if what registers LiDARs were installed."""
    monkeypatch.setattr(nearest, "installed", lambda: True)
