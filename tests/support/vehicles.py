"""A pair without threads, driven frame pair by frame pair, with a worker that knows the truth; and a vehicle that
answers on a real session with such a pair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from coec.calibration.frames.window import SliceClosed
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import (
    MOVED,
    CameraFrame,
    Decision,
    EgoMotion,
    EncodedImage,
    Estimate,
    FramePair,
    ImageFormat,
    LidarFrame,
    Matrix4,
    MovedWithin,
    Reason,
    Uncertainty,
    Verdict,
)
from coec.config import (
    AuthorityConfig,
    BudgetConfig,
    CalibrationConfig,
    Config,
    LimitsConfig,
    UplinkConfig,
    ZenohConfig,
)
from coec.geometry import se3
from coec.io.disk_writer import DiskWriter, Persistable
from coec.io.logs import LossCounter
from coec.io.rig_files import rig_of
from coec.io.serialise import result_of
from coec.io.zenoh.bus import Bus, open_session
from coec.io.zenoh.command_auth import CommandListener, credentials_of
from coec.io.zenoh.ros_node import RosTopicList
from coec.io.zenoh.session import Reach, settings_of
from coec.schemas.commands import Acknowledgement
from coec.schemas.keys import Keys
from coec.schemas.replies import HistoryEntry
from coec.service import camera_lidar_pair as runtime_pair
from coec.service.api.authorization import Authority, CommandHandler, CommandRules
from coec.service.api.reply_builders import SerializedReply
from coec.service.api.rig_answers import RigAnswers
from coec.service.api.routes import VehicleReplies, VehicleRoutes
from coec.service.api.uplink import Heartbeats, Uplink
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.configuration import redacted_configuration
from coec.service.cpu_budget import Budget
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
from coec.service.recording.recorder import (
    RecordBetween,
    RecordingPlan,
    RecordingThread,
    RecordPair,
    WindowLost,
    WindowRecorded,
)
from coec.service.recording.snippets import SnippetRecorder
from coec.service.recording.window_store import WindowStore
from coec.service.records.pair_store import PairStore
from coec.service.records.state_store import StateStore
from coec.service.timing import Clock
from coec.service.vehicle_context import VehicleContext
from coec.service.worker.supervisor import Worker
from coec.service.worker.worker_jobs import (
    Answer,
    Checked,
    Cost,
    Fate,
    JobOutcome,
    Kind,
    RenderedImage,
    Solved,
    WorkerJob,
    cost_of,
    unpack_pairs,
)
from support.estimates import estimate
from support.messages import status_reply

NS_PER_S = 1_000_000_000
BEGIN_S = 1_000_000
STEP_S = BEGIN_S + 100
"""When the mount moves."""

DRIVE_END_S = STEP_S + 100

NOMINAL = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
BEFORE = se3.perturb(NOMINAL, np.radians([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
AFTER = se3.perturb(NOMINAL, np.radians([0.1, 1.0, 0.0, 0.0, 0.0, 0.0]))
WIDTH, HEIGHT = 16, 12
NOISE = 8e-4
"""Of a check, rad or m."""


def true_pose(stamp_ns: int) -> Matrix4:
    return BEFORE if stamp_ns < STEP_S * NS_PER_S else AFTER


def pair_configuration(folder: Path, apply: str = "within_limits", vehicle: str = "test") -> Config:
    pair = {
        "name": "front",
        "camera": {
            "key": "in/camera",
            "intrinsics": {
                "model": "pinhole",
                "width": WIDTH,
                "height": HEIGHT,
                "fx": 8.0,
                "fy": 8.0,
                "cx": 7.5,
                "cy": 5.5,
            },
        },
        "lidar": {"key": "in/lidar"},
        "ego": {"key": "in/ego"},
        "T_camera_lidar": NOMINAL.tolist(),
        "window": {
            "pairs": 10,
            "min_pairs": 5,
            "slice_s": 40.0,
            "min_sharpness": 0.0,
            "min_mean_level": 0.0,
            "max_clipped": 1.0,
            "min_points_in_view": 1,
        },
        "monitor": {"period_s": 5.0, "pairs": 5, "min_pairs": 4, "urgent_slice_s": 10.0},
        "policy": {"apply": apply},
        "calibration": {"depth": {"model": "stereo"}},
    }
    return Config.model_validate(
        {"vehicle": vehicle, "state": {"directory": str(folder), "min_free_bytes": 0}, "pairs": [pair]}
    )


def frame_pair_at(stamp_ns: int, speed_mps: float = 5.0) -> FramePair:
    rng = np.random.default_rng(stamp_ns % (2**32))
    image = EncodedImage(ImageFormat.MONO8, WIDTH, HEIGHT, rng.bytes(WIDTH * HEIGHT))
    cloud = np.array([[10.0, 0.0, 0.0], [20.0, 1.0, 0.5]], dtype=np.float32)
    motion = EgoMotion(stamp_ns, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, 0.0))
    return FramePair(CameraFrame(stamp_ns, "camera", image), LidarFrame(stamp_ns, "lidar", cloud), motion)


PAIR_RIG = rig_of(pair_configuration(Path("state")).pairs[0])


@dataclass
class OracleWorker:
    """Answers at once, and rightly. `cost_s`: processor time that work of a kind takes, for which `pay` is told;
    `checked` are the stamps of the pairs of each check, `drawn` the questions for pictures, `commissionings` says how
    far those of pairs are. `truth` is the pose at a stamp; `scatter` draws the noise of the checks, None: they have
    none."""

    truth: Callable[[int], Matrix4] = true_pose
    scatter: np.random.Generator | None = None
    cause: str | None = None
    baseline_not_used: str | None = None
    fault: Reason | None = None
    window_fault: Reason | None = None
    bias: Matrix4 = field(default_factory=lambda: np.eye(4))
    estimates: dict[str, Estimate] = field(default_factory=dict)
    cost_s: dict[Kind, float] = field(default_factory=dict)
    pay: Callable[[Cost], None] = lambda _: None
    checked: list[tuple[int, ...]] = field(default_factory=list)
    overlays: list[WorkerJob] = field(default_factory=list)
    commissionings: dict[str, str] = field(default_factory=dict)
    warms_up: bool = False
    compiled_s: float = 0.0

    def commissioning(self, pair: str) -> str | None:
        return self.commissionings.get(pair)

    def submit(self, job: WorkerJob) -> None:
        if job.kind in self.cost_s:
            self.pay(cost_of(job, self.cost_s[job.kind]))
        handlers: dict[Kind, Callable[[WorkerJob], Answer]] = {
            Kind.CHECK: self._check,
            Kind.SOLVE: self._solve,
            Kind.OVERLAY: self._render_overlay,
        }
        answer = handlers.get(job.kind)
        fault = self.fault if job.kind is Kind.CHECK else self.window_fault if job.kind is Kind.SOLVE else None
        if fault is not None or answer is None:
            job.done(JobOutcome(Fate.FAILED, None, fault or Reason("no", "not here"), 0.1))
        else:
            job.done(JobOutcome(Fate.RESULT, answer(job), None, 0.1))

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Nothing is inferred."""

    def _check(self, job: WorkerJob) -> Checked:
        pairs = unpack_pairs(job.body["frames"], LimitsConfig())
        self.checked.append(tuple(pair.stamp_ns for pair in pairs))
        wrong = [se3.difference(np.array(job.body["pose"]), self.truth(pair.stamp_ns)) for pair in pairs]
        offset = np.mean(wrong, axis=0)
        if self.scatter is not None:
            offset = offset + self.scatter.normal(0.0, NOISE, 6)
        observation = Observation(
            stamp_ns=pairs[-1].stamp_ns,
            pair_stamps_ns=tuple(pair.stamp_ns for pair in pairs),
            metrics=(),
            offset=offset,
            sigma=np.full(6, 1e-3),
            noise=np.full(6, NOISE),
            place=np.full(6, 5e-4),
            dispersion=1.0,
            distance2=float(np.abs(offset).max() / 0.005),
            flagged=bool(np.abs(offset).max() > 0.005),
            weak=False,
            flagged_by_paper=None,
            causes=() if self.cause is None else (CAUSES[self.cause],),
        )
        return Checked(observation, self.baseline_not_used)

    def _render_overlay(self, job: WorkerJob) -> RenderedImage:
        self.overlays.append(job)
        return RenderedImage(b"jpeg " + job.subject.encode())

    def _solve(self, job: WorkerJob) -> Solved:
        return Solved(result_of(self.estimates[job.subject], PAIR_RIG, "test"), None)


@dataclass
class SlowWorker(OracleWorker):
    """Answers in its own time, and out of order: some of what waits, whenever it is let."""

    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    waiting: list[WorkerJob] = field(default_factory=list)

    def submit(self, job: WorkerJob) -> None:
        self.waiting.append(job)

    def work(self, share: float) -> None:
        """Answer this share of the questions that wait."""
        for job in [one for one in self.waiting if self.rng.random() < share]:
            self.waiting.remove(job)
            super().submit(job)


class InstantRecorder:
    """Tells the worker what is in a window, the moment it ends: the truth of its pairs, or what lies between two. A
    window has three degrees of freedom: it sees no translation."""

    worker: OracleWorker

    def __init__(
        self,
        plan: RecordingPlan,
        folder: WindowStore,
        losses: LossCounter,
        recording: RecordingThread,
        post: Callable[[str, WindowRecorded | WindowLost], None],
        snippets: SnippetRecorder | None,
    ) -> None:
        del losses, recording, snippets
        self.plan, self.configuration = plan, plan.configuration
        self.problem = None
        self.has_room = True
        self.waiting = 0
        self.recorded = 0
        self.loses = False
        self.sees_moves = False
        self.stamps: dict[str, list[int]] = {}
        self.between: dict[str, list[int]] = {}
        self.latest: Path | None = None
        self._folder = folder
        self._post = post
        self._stamps: list[int] = []

    has_work = False

    def work(self) -> bool:
        return False

    def work_in_idle_time(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""

    def follow(self, plan: RecordingPlan) -> None:
        self.plan = plan

    def reconfigure(self, configuration: CalibrationConfig) -> None:
        self.configuration = configuration

    def add(self, item: RecordPair | RecordBetween) -> None:
        stamps = self._stamps if isinstance(item, RecordPair) else self.between.setdefault(item.window_id, [])
        stamps.append(item.pair.stamp_ns)

    def end(self, slice_end: SliceClosed) -> None:
        stamps, self._stamps = self._stamps, []
        if not slice_end.complete:
            return
        if slice_end.carried_over is not None:
            carried_over = [
                stamp
                for stamp in self.stamps[slice_end.carried_over.window_id]
                if stamp >= slice_end.carried_over.since_ns
            ]
            assert len(carried_over) == slice_end.carried_over.pairs
            stamps = carried_over + stamps
        assert len(stamps) == slice_end.pairs
        self.stamps[slice_end.window_id] = stamps
        if self.loses:
            self._post(self.plan.rig.pair, WindowLost(slice_end.window_id))
            return
        self.recorded += 1
        self.latest = self._folder.path(slice_end.window_id)
        self.latest.touch()
        moved = np.mean([se3.difference(self._seen(stamp), NOMINAL) for stamp in stamps], axis=0)
        pose = se3.perturb(NOMINAL, moved) @ self.worker.bias
        made = estimate(1)
        self.worker.estimates[slice_end.window_id] = replace(
            made,
            window_id=slice_end.window_id,
            data_stamp_ns=stamps[-1],
            optimum=replace(made.optimum, T_camera_lidar=pose),
            correction=se3.difference(pose, NOMINAL),
            uncertainty=Uncertainty.independent(np.array([5e-4] * 3 + [np.nan] * 3)),
        )
        late = [stamp for stamp in stamps if stamp >= STEP_S * NS_PER_S]
        if self.sees_moves and 0 < len(late) < len(stamps):
            self.worker.estimates[slice_end.window_id] = estimate_across_move(
                self.worker.estimates[slice_end.window_id], stamps, late, self._seen
            )
        self._folder.hold(slice_end.window_id)
        self._post(self.plan.rig.pair, WindowRecorded(slice_end.window_id, self.latest, True))

    def _seen(self, stamp_ns: int) -> Matrix4:
        """The pose at a stamp as far as windows see it."""
        pose = self.worker.truth(stamp_ns).copy()
        pose[:3, 3] = NOMINAL[:3, 3]
        return pose


class InstantDiskWriter(DiskWriter):
    """Writes on the thread that asks."""

    def write(self, *books: Persistable) -> None:
        super().write(*books)
        self.write_due()


def estimate_across_move(of: Estimate, stamps: list[int], late: list[int], seen: Callable[[int], Matrix4]) -> Estimate:
    """The estimate of a window that was refused as it holds the step."""
    last_before = stamps[stamps.index(late[0]) - 1]
    verdict = Verdict(Decision.FAILED, (), (Reason(MOVED, "the camera moved"),))
    return replace(
        of, verdict=verdict, moved=MovedWithin(last_before, late[0], len(late), seen(last_before), seen(late[0]))
    )


class ShiftedClock(Clock):
    """That of the machine, ahead by some seconds."""

    ahead_s = 0.0

    def monotonic_s(self) -> float:
        return super().monotonic_s() + self.ahead_s


class PairBench:
    """A pair without threads, driven pair by pair; `restart` replaces it by one that reads the same folder."""

    def __init__(
        self,
        folder: Path,
        apply: str = "within_limits",
        worker: type[OracleWorker] = OracleWorker,
        vehicle: str = "test",
        authority: AuthorityConfig | None = None,
        cores: float = 0.5,
        truth: Callable[[int], Matrix4] = true_pose,
    ) -> None:
        config = pair_configuration(folder, apply, vehicle)
        self.config = config.model_copy(
            update={"authority": authority or config.authority, "budget": BudgetConfig(cores=cores)}
        )
        self.kind = worker
        self.truth = truth
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.restart()

    def restart(self) -> None:
        windows = WindowStore(self.folder / "windows", self.config.state)
        self.budget = Budget(self.config.budget, lambda: 0.0)
        self.worker = self.kind()
        self.worker.pay = self.budget.pay
        self.worker.truth = self.truth
        store = StateStore(self.folder, self.config.vehicle)
        self.published: list[str] = []
        self.shown: list[str] = []
        disk_writer = InstantDiskWriter(self.folder)
        rig = RigEstimator(self.folder, (), disk_writer)
        self.clock = ShiftedClock()
        self.vehicle = Vehicle(self.config.limits, self.budget, rig, lambda _: None, clock=self.clock)
        self.context = VehicleContext(
            Keys("coec", self.config.vehicle),
            self.vehicle,
            store,
            disk_writer,
            windows,
            RecordingThread(),
            cast("Worker", self.worker),
            lambda key, _: self.published.append(key),
            lambda: (),
            lambda pair, _overlay, _pose: self.shown.append(pair.name),
            RosTopicList,
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runtime_pair, "Recorder", InstantRecorder)
            self.pair = CameraLidarPair(self.config.pairs[0], self.config, self.context)
        self.recorder.worker = self.worker
        self.answers = self.pair.answers

    @property
    def recorder(self) -> InstantRecorder:
        return cast("InstantRecorder", self.pair.recorder)

    @property
    def store(self) -> PairStore:
        return self.answers._store

    @property
    def losses(self) -> dict[tuple[str, str], int]:
        return self.pair.stream.losses()

    def drive(self, begin_s: int, end_s: int, speed_mps: float = 5.0) -> None:
        for stamp_ns in range(begin_s * NS_PER_S, end_s * NS_PER_S, NS_PER_S // 2):
            self.hold(frame_pair_at(stamp_ns, speed_mps))
            self.settle()
        if isinstance(self.worker, SlowWorker):
            self.worker.work(share=1.0)
            self.settle()

    def settle(self) -> None:
        """What the engine does until there is nothing more that it may do."""
        while self.vehicle.turn(0.0):
            self.renew_report()
        if isinstance(self.worker, SlowWorker):
            self.worker.work(share=0.05)

    def hold(self, pair: FramePair) -> None:
        """A frame pair has come."""
        self.pair.stream.hold([pair], self.clock.monotonic_s(), set_clock=True)

    def renew_report(self) -> None:
        self.pair.stream.renew_report(self.pair.engine.selector.statistics, self.clock.monotonic_s())

    def check_clocks(self, ahead_s: float = 0.0) -> None:
        """The clocks are evaluated as they will be in `ahead_s`."""
        self.clock.ahead_s = ahead_s
        self.renew_report()
        self.pair._tick()
        self.clock.ahead_s = 0.0

    def do(self, name: str, **arguments: Any) -> str:
        return self.acknowledged(name, **arguments).code

    def acknowledged(self, name: str, **arguments: Any) -> Acknowledgement:
        with ThreadPoolExecutor(1) as other:
            future = other.submit(self.pair.commands.carry_out, name, arguments, "the test")
            while not future.done():
                self.settle()
        self.settle()
        return future.result()

    @property
    def pose(self) -> Matrix4:
        return self.store.state.T_camera_lidar

    @property
    def health(self) -> str:
        return self.store.state.health.value

    def entries(self, *kinds: str) -> list[HistoryEntry]:
        return [record.entry for record in self.store.history.entries() if record.entry.kind in kinds]

    def decisions(self) -> list[tuple[str, str]]:
        return [(entry.kind, entry.code) for entry in self.entries("state", "extrinsic")]


VEHICLE = "vehicle"
PAIR = "front"
KEYS = Keys("coec", VEHICLE)
VEHICLE_LIMITS = LimitsConfig()
STOP_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class ServingVehicle:
    """What answers, and what it is made of."""

    bench: PairBench
    bus: Bus
    uplink: Uplink

    @property
    def is_held(self) -> bool:
        """Whether the last `hold` was one that held."""
        return self.bench.store.state.hold is not None

    @property
    def commands(self) -> dict[str, int]:
        """Counts, as `status` says them."""
        return self.bench.answers.status().commands


def serve(bench: PairBench, config: ZenohConfig, bus: Bus) -> ServingVehicle:
    """Declare all that a vehicle answers, as the daemon does."""
    pair, authority = bench.pair, bench.config.authority
    credentials = credentials_of(authority)
    rules = CommandRules(
        Authority(authority, Reach(settings_of(config, VEHICLE_LIMITS)).exposure),
        None if credentials is None else CommandListener(credentials),
    )
    command_handler = CommandHandler(rules, {pair.name: pair.commands})
    document = SerializedReply.of_document(
        {"schema_version": 1, "config_hash": "0", "config": redacted_configuration(bench.config)}
    )
    status = SerializedReply.of(status_reply(vehicle=VEHICLE, pairs=(pair.answers.status(),)))
    uplink = Uplink(UplinkConfig())
    heartbeats = Heartbeats(KEYS, "0", UplinkConfig(), bus.publish)
    VehicleRoutes(
        KEYS,
        {pair.name: pair.answers},
        command_handler,
        VehicleReplies(status, document),
        lambda: b"# EOF\n",
        RigAnswers(KEYS, bus.publish),
        heartbeats,
        uplink,
    ).declare(bus)
    heartbeats.renew("running", "0", [pair.answers])
    for name, answer in (("extrinsic", pair.answers.extrinsic), ("health", pair.answers.health)):
        bus.publish(f"{KEYS.root}/{pair.name}/{name}", answer("msgpack"))
    bus.declare_alive(KEYS.alive(pair.name))
    return ServingVehicle(bench, bus, uplink)


@contextmanager
def serving(
    folder: Path,
    config: ZenohConfig,
    authority: AuthorityConfig | None = None,
    before: Callable[[PairBench], None] = lambda _: None,
) -> Iterator[ServingVehicle]:
    """A vehicle in a session of its own, until the end of the block; `before` is what it did before it was asked."""
    bench = PairBench(folder, vehicle=VEHICLE, authority=authority)
    before(bench)
    bus = Bus(open_session(config, VEHICLE_LIMITS))
    threads = (*bus.threads, bench.vehicle.thread)
    for thread in threads:
        thread.start()
    try:
        yield serve(bench, config, bus)
    finally:
        bus.undeclare_inputs()
        bench.vehicle.request_stop()
        for thread in threads:
            thread.request_stop()
        assert all(thread.join(STOP_TIMEOUT_S) for thread in threads)
        bus.undeclare_queryables()
        assert bus.close(STOP_TIMEOUT_S)
