"""Rigs without sensors or threads: small graphs of sensors, checks and windows that say what a test says, a rig as it
is driven, and benches that stand for the rig's thread and for the LiDARs of a vehicle.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import radians
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.rig import edge_observations, nearest_neighbours, rig_estimator
from coec.calibration.rig.attribution import RigState, SensorHealth, after_edge_observation, initial
from coec.calibration.rig.edge_observations import EdgeObservation
from coec.calibration.rig.graph import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.rig.lidar_sampling import LidarRig, RangeBias
from coec.calibration.rig.rig_estimator import EdgeWindow, ServedEdge, VehicleRig
from coec.calibration.state import PairState, initial_state
from coec.calibration.tracker import Measurement
from coec.calibration.types import EgoMotion, Frame, LidarFrame, Matrix4, Reason, Uncertainty
from coec.config import BudgetConfig, LidarEdgesConfig, LimitsConfig, PairConfig
from coec.geometry import se3
from coec.io.converter import structured
from coec.io.disk_writer import DiskWriter
from coec.schemas.rig_state import LidarsReply, RigReply
from coec.service.api.rig_answers import reply_of
from coec.service.cpu_budget import Budget
from coec.service.engine.lidar_pairs import LidarPairs
from coec.service.engine.rig import RigEstimator, RigMember, RigSnapshot
from coec.service.engine.vehicle import Vehicle
from coec.service.ingest.decoder import EGO
from coec.service.worker.supervisor import Worker
from coec.service.worker.worker_jobs import (
    Answer,
    Fate,
    JobOutcome,
    Registered,
    WorkerJob,
    unpack_sweeps,
    wire_form,
)
from support.vehicles import PAIR_RIG, pair_configuration

SIGMA = np.array([radians(0.06)] * 3 + [0.015] * 3)
PLACE = np.array([radians(0.04)] * 3 + [0.01] * 3)
BIAS = np.array([radians(0.12)] * 3 + [0.03] * 3)
TURN = np.array([0.0, radians(1.0), 0.0, 0.0, 0.0, 0.0])
NS = 1_000_000_000

POSES: Mapping[str, Matrix4] = {
    "front": se3.exp(np.array([1.2, -1.2, 1.2, 0.1, -0.8, 3.0])),
    "left": se3.exp(np.array([1.5, 0.1, 0.2, 0.5, 1.0, -1.0])),
    "rear": se3.exp(np.array([1.2, 1.2, -1.2, -0.4, 0.9, 1.0])),
    "roof": se3.exp(np.array([0.0, 0.02, 0.1, -1.2, 0.0, -1.9])),
    "bumper": se3.exp(np.array([0.0, 0.02, 1.0, -3.2, 0.9, -0.6])),
}
"""T_sensor_rig (4, 4); what is called after a mount is a LiDAR."""


def graph(
    pairs: Sequence[tuple[str, str]], links: Sequence[RigidLink] = (), poses: Mapping[str, Matrix4] = POSES
) -> RigGraph:
    """The sensors of some pairs, each (camera, LiDAR) or two of a kind."""
    names = dict.fromkeys(name for pair in pairs for name in pair)
    sensors = [Sensor(name, SensorKind.LIDAR if name in ("roof", "bumper") else SensorKind.CAMERA) for name in names]
    return RigGraph.of(sensors, [Edge(f"{a}-{b}", a, b, poses[a] @ se3.inverse(poses[b])) for a, b in pairs], links)


def edge_check(edge: Edge, poses: Mapping[str, Matrix4], at_s: float, error: NDArray[np.float64]) -> EdgeObservation:
    """One that puts an edge where these poses have it, but for an error (6,); a pair that was moved suspects so."""
    right = poses[edge.a] @ se3.inverse(poses[edge.b])
    stamp_ns, moved = round(at_s * NS), bool(np.abs(se3.difference(right, edge.T_a_b)).max() > 1e-6)
    information = np.diag(1.0 / SIGMA**2)
    return EdgeObservation(
        edge.name, stamp_ns, se3.perturb(right, error), information, PLACE, BIAS, stepped_ns=stamp_ns if moved else None
    )


def checked_rig(
    rig: RigGraph,
    before: Mapping[str, Matrix4],
    after: Mapping[str, Matrix4],
    rounds: tuple[int, int] = (7, 5),
    seed: int = 1,
) -> RigState:
    """Rounds of looks at every edge, 5 s apart, before and after something happened."""
    rng, state = np.random.default_rng(seed), initial(rig)
    for turn in range(sum(rounds)):
        for place, edge in enumerate(rig.edges):
            poses = before if turn < rounds[0] else after
            state = after_edge_observation(
                state, rig, edge_check(edge, poses, 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            )
    return state


def moved_poses(*names: str, xi: NDArray[np.float64] = TURN) -> dict[str, Matrix4]:
    """The poses after some sensors moved by ξ about their own axes."""
    return {name: se3.perturb(pose, xi) if name in names else pose for name, pose in POSES.items()}


def edge_windows(
    rig: RigGraph, poses: Mapping[str, Matrix4], seed: int, sigma: NDArray[np.float64] = SIGMA
) -> dict[str, Measurement]:
    """One of each edge, off by so much."""
    rng = np.random.default_rng(seed)
    return {
        edge.name: Measurement(
            se3.perturb(poses[edge.a] @ se3.inverse(poses[edge.b]), sigma * rng.normal(size=6)),
            Uncertainty.independent(sigma),
            NS,
        )
        for edge in rig.edges
    }


CAMERAS = ("front", "left", "rear")
CameraPoses = Mapping[str, Matrix4]


def pair_config(name: str) -> PairConfig:
    """A pair of a camera and the LiDAR `roof`."""
    pair = pair_configuration(Path("state")).pairs[0]
    camera = pair.camera.model_copy(update={"name": name, "key": f"in/{name}"})
    lidar = pair.lidar.model_copy(update={"name": "roof", "key": "in/roof"})
    return pair.model_copy(update={"name": f"{name}-roof", "camera": camera, "lidar": lidar})


def pair_pose(camera: str, poses: CameraPoses) -> Matrix4:
    """(4, 4) of a camera and the LiDAR."""
    return np.asarray(poses[camera] @ se3.inverse(poses["roof"]))


def pair_state(camera: str, poses: CameraPoses = POSES) -> PairState:
    """A pair that serves its nominal calibration."""
    return replace(initial_state(PAIR_RIG), T_camera_lidar=pair_pose(camera, poses))


def pair_check(camera: str, poses: CameraPoses, at_s: float, error: NDArray[np.float64]) -> EdgeObservation:
    """A check that puts a pair where these poses have it, but for an error (6,)."""
    T_a_b = se3.perturb(pair_pose(camera, poses), error)
    return EdgeObservation(f"{camera}-roof", round(at_s * NS), T_a_b, np.diag(1.0 / SIGMA**2), PLACE, BIAS)


def pair_window(camera: str, poses: CameraPoses, start_s: float) -> EdgeWindow:
    """A window of ten seconds without an error."""
    stamp_ns = round((start_s + 10.0) * NS)
    measurement = Measurement(pair_pose(camera, poses), Uncertainty.independent(SIGMA), stamp_ns)
    return EdgeWindow(measurement, round(start_s * NS))


def served_extrinsic(camera: str, poses: CameraPoses, start_s: float) -> ServedEdge:
    """What a pair serves by frames since then."""
    return ServedEdge(pair_pose(camera, poses), SIGMA, round(start_s * NS))


class RigEstimatorBench:
    """The rig, whose turns the test does.

    Attributes:
        pairs: by camera.
        states: what the rig reported, in order.
    """

    def __init__(self, folder: Path, cameras: tuple[str, ...] = CAMERAS, poses: CameraPoses = POSES) -> None:
        self.disk_writer = DiskWriter(folder)
        self.estimator = RigEstimator(folder, (), self.disk_writer)
        self.states: list[RigSnapshot] = []
        self.pairs: dict[str, RigMember] = {}
        for camera in cameras:
            known = pair_state(camera, poses)
            self.pairs[camera] = self.estimator.join(pair_config(camera), pair_pose(camera, POSES), known)
        self.states.append(self.estimator.snapshot)
        self.settle()

    def settle(self) -> None:
        """What the engine does until there is nothing to be done."""
        while self.estimator.take_report(all_are_silent=self.estimator.is_quiet):
            self.states.append(self.estimator.snapshot)

    def put(self, camera: str, due_s: float, report: EdgeObservation | EdgeWindow | ServedEdge) -> None:
        """A pair says something."""
        self.estimator.put(f"{camera}-roof", round(due_s * NS), report)

    def must_wait(self, camera: str, at_s: float, *, waits: bool = False) -> bool:
        """A pair has frames of this time; whether it has to wait for the rig."""
        self.pairs[camera].report_time(round(at_s * NS), waits=waits)
        return self.pairs[camera].waits(round(at_s * NS))

    @property
    def known(self) -> RigSnapshot:
        """What was told last."""
        return self.states[-1]


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
            structured(wire_form(), job.body["lidars"], LidarRig),
            unpack_sweeps(job.body["frames"], LimitsConfig())[-1].a.stamp_ns,
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
        self.estimator = RigEstimator(folder, (), DiskWriter(folder))
        self.worker = FakeLidarWorker(answers)
        self.budget = Budget(BudgetConfig(cores=cores), lambda: 0.0)
        self.states: list[RigSnapshot] = []
        self.vehicle = Vehicle(LimitsConfig(), self.budget, self.estimator, self.states.append)
        self.ego = ego
        self.pairs: list[RigMember] = []
        configs = [self.join(lidar) for lidar in lidars]
        worker = cast("Worker", self.worker)
        self.edges = LidarPairs(LidarEdgesConfig(period_s=period_s), self.vehicle, worker)
        self.edges.grow(configs)
        self.settle()

    def join(self, lidar: str) -> PairConfig:
        """A pair of it becomes one of the rig."""
        config = lidar_pair(lidar, ego=self.ego)
        self.vehicle.sensors_of(config)
        self.pairs.append(self.estimator.join(config, np.array(config.T_camera_lidar), pair_state("front")))
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
                    pair.report_time(stamp_ns, waits=False)
                self.settle()
        self.settle()

    def push(self, stream: str, frame: Frame) -> None:
        """A frame came."""
        for sensor in self.vehicle.sensors:
            if sensor.config.sensor in (stream, f"in/{stream}"):
                for taker in sensor.takers:
                    taker(frame, self.vehicle.clock.monotonic_s())

    def settle(self) -> None:
        """What the engine does until there is nothing more that it may do."""
        self.answer_some()
        while self.vehicle.turn(0.0):
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
    monkeypatch.setattr(nearest_neighbours, "installed", lambda: True)


LIDAR_CHECK_SIGMA = np.array([*np.radians([0.04, 0.02, 0.02]), 0.009, 0.004, 0.005])
"""(6,) what a look at two LiDARs claims (rad, m)."""

STAR = (("front", "roof"), ("left", "roof"), ("rear", "roof"))
LOOPS = (*STAR, ("front", "bumper"), ("left", "bumper"))
RigPoses = Mapping[str, Matrix4]


def pose_of(edge: Edge, poses: RigPoses) -> Matrix4:
    """(4, 4) where these poses have an edge."""
    return np.asarray(poses[edge.a] @ se3.inverse(poses[edge.b]))


def windowed_measurement(edge: Edge, poses: RigPoses, start_s: float, error: NDArray[np.float64]) -> EdgeWindow:
    """A window of ten seconds that puts an edge where these poses have it, but for an error (6,)."""
    pose = se3.perturb(pose_of(edge, poses), error)
    stamp_ns = round((start_s + 10.0) * NS)
    return EdgeWindow(Measurement(pose, Uncertainty.independent(SIGMA), stamp_ns), round(start_s * NS))


def known_of(edge: Edge, poses: RigPoses, at_s: float) -> Measurement:
    """What many windows up to a time say of the mount."""
    return Measurement(pose_of(edge, poses), Uncertainty.independent(0.2 * SIGMA), round(at_s * NS))


class RigDrive:
    """A rig as it is driven: looks of all pairs every 5 s, windows that pairs serve at once, and looks at LiDARs."""

    def __init__(self, rig: RigGraph, seed: int = 1) -> None:
        self.rng = np.random.default_rng(seed)
        self.at_s = 0.0
        serves = {
            edge.name: ServedEdge(pose_of(edge, POSES), SIGMA, 0, known_of(edge, POSES, -5.0)) for edge in rig.edges
        }
        windows = {edge.name: windowed_measurement(edge, POSES, -30.0, self._error()) for edge in rig.edges}
        self.state: VehicleRig = rig_estimator.initial_rig(rig, serves, windows)

    def _error(self) -> NDArray[np.float64]:
        return np.asarray(SIGMA * self.rng.normal(size=6))

    def add_checks(self, poses: RigPoses, rounds: int, blind: tuple[str, ...] = ()) -> None:
        for _ in range(rounds):
            for index, edge in enumerate(self.state.graph.edges):
                if edge.name not in (*blind, *self.state.graph.of_lidars):
                    seen = edge_check(edge, poses, self.at_s + 0.5 * index, self._error())
                    self.state = rig_estimator.after_edge_observation(self.state, seen)
            self.at_s += 5.0

    def add_window(self, name: str, poses: RigPoses, start_s: float, *, serves: bool = True) -> Matrix4:
        window = windowed_measurement(self.state.graph.edge[name], poses, start_s, self._error())
        stamp_ns = round(self.at_s * NS)
        self.state = rig_estimator.after_window(self.state, name, window, stamp_ns)
        pose = window.measurement.T_camera_lidar
        if serves:
            self.state = rig_estimator.after_served(
                self.state, name, ServedEdge(pose, SIGMA, window.start_ns), stamp_ns
            )
        return pose

    def health(self) -> dict[str, SensorHealth]:
        return {sensor.name: sensor.health for sensor in self.state.sensors}

    def add_lidar_check(self, name: str, poses: RigPoses, error: NDArray[np.float64] | None = None) -> None:
        """A look at two LiDARs that were there two seconds ago, off by an error (6,) beside what it claims."""
        edge = self.state.graph.edge[name]
        off = LIDAR_CHECK_SIGMA * self.rng.normal(size=6) + (0.0 if error is None else error)
        T_a_b, stamp_ns = se3.perturb(pose_of(edge, poses), off), round(self.at_s * NS)
        seen = edge_observations.observation_of_registration(name, stamp_ns, T_a_b, np.diag(LIDAR_CHECK_SIGMA**2))
        window = EdgeWindow(
            edge_observations.window_of(stamp_ns, T_a_b, np.diag(LIDAR_CHECK_SIGMA**2)), stamp_ns - 2 * NS
        )
        self.state = rig_estimator.after_lidars(self.state, seen, window)
