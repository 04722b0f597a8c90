"""Live is replayed: whatever the machine does meanwhile, the same frames make the same windows and the same checks, of
the same pairs, at the same extrinsics.

A drive is sent twice: once in the order of its stamps, to a worker that answers at once; and once with each stream in
its own order but late by whatever is allowed, to a worker that takes its time, with a clock that stalls.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.frames.pairing import MOTION_LATE_NS
from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame
from coec.config import LimitsConfig
from coec.service.engine.messages import Action
from coec.service.recording.recorder import RecordBetween, RecordPair
from coec.service.worker.worker_jobs import Kind, WorkerJob, unpack_pairs
from support.vehicles import BEGIN_S, DRIVE_END_S, NS_PER_S, OracleWorker, PairBench, SlowWorker, frame_pair_at

Frame = CameraFrame | LidarFrame | EgoMotion

MOTION_NS = NS_PER_S // 10
PARKED_S = (BEGIN_S + 30, BEGIN_S + 75)
"""Nothing is sent between these: the first slice ends meanwhile, and its window corrects what is served."""

AHEAD = 12
"""Frames by which camera and LiDAR may be ahead of one another; `pairing.queue_frames` are 16."""

STALL_S = 25.0
"""Of the whole service; a check is overdue after fifteen."""


class Clock:
    """The steady clock of the machine."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


def streams() -> dict[str, deque[Frame]]:
    """Of a drive on which the mount moves, and the vehicle is parked for a while."""
    stamps = [
        stamp_ns
        for stamp_ns in range(BEGIN_S * NS_PER_S, DRIVE_END_S * NS_PER_S, NS_PER_S // 2)
        if not PARKED_S[0] * NS_PER_S <= stamp_ns < PARKED_S[1] * NS_PER_S
    ]
    pairs = [frame_pair_at(stamp_ns) for stamp_ns in stamps]
    ends = ((BEGIN_S, PARKED_S[0]), (PARKED_S[1], DRIVE_END_S))
    motions = [
        EgoMotion(stamp_ns + 7_000_000, "ego", (5.0 + (stamp_ns // MOTION_NS) % 7, 0.0, 0.0), (0.0, 0.0, 0.01))
        for begin_s, end_s in ends
        for stamp_ns in range(begin_s * NS_PER_S, end_s * NS_PER_S, MOTION_NS)
    ]
    return {
        "camera": deque(pair.camera for pair in pairs),
        "lidar": deque(pair.lidar for pair in pairs),
        "ego": deque(motions),
    }


class Watched:
    """A pair, and everything that its stream makes of the frames, in order."""

    def __init__(self, folder: Path, worker: type[OracleWorker]) -> None:
        self.bench = PairBench(folder, worker=worker)
        self.checked: list[Any] = []
        self.windows: list[Any] = []
        self.checks: list[Any] = []
        bench = self.bench
        bench.recorder.sees_moves = True
        select, add, end, query = (
            bench.pair.engine.selector.select,
            bench.recorder.add,
            bench.recorder.end,
            bench.worker.submit,
        )

        def selected(pair: FramePair) -> list[Action]:
            self.checked.append((pair.camera.stamp_ns, pair.lidar.stamp_ns, pair.motion))
            return select(pair)

        def added(item: RecordPair | RecordBetween) -> None:
            if isinstance(item, RecordPair):
                self.windows.append((item.window_id, item.pair.stamp_ns, item.T_camera_lidar.tobytes()))
            add(item)

        def finished(slice_end: SliceClosed) -> None:
            self.windows.append(slice_end)
            end(slice_end)

        def requested(job: WorkerJob) -> None:
            if job.kind is Kind.CHECK:
                pairs = unpack_pairs(job.body["frames"], LimitsConfig())
                self.checks.append((job.body["pose"], [(pair.stamp_ns, pair.motion) for pair in pairs]))
            query(job)

        bench.pair.engine.selector.select = selected  # type: ignore[method-assign]
        bench.recorder.add, bench.recorder.end = added, finished  # type: ignore[method-assign]
        bench.worker.submit = requested  # type: ignore[method-assign]

    def push(self, frame: Frame) -> None:
        self.bench.pair.stream.push(frame, self.bench.clock.monotonic_s())
        self.bench.settle()

    def finish(self) -> None:
        """The streams have ended, and all is judged."""
        self.bench.pair.stream.flush(self.bench.clock.monotonic_s())
        for _ in range(1000):
            if isinstance(self.bench.worker, SlowWorker):
                self.bench.worker.work(share=1.0)
            self.bench.settle()
            if not self.bench.pair.stream.report.held:
                return
        pytest.fail("pairs wait for ever")

    @property
    def reported(self) -> dict[str, Any]:
        entries = [
            entry.model_copy(update={"wall_ns": 0, "previous_sha256": "", "sequence": 0})
            for entry in self.bench.entries("estimate", "extrinsic")
        ]
        # Whether an answer is overdue is the clock's on the wall to say.
        codes = [entry.code for entry in self.bench.entries("state") if entry.code not in ("degraded", "stale")]
        return {
            "looked": self.checked,
            "windows": self.windows,
            "checks": self.checks,
            "entries": entries,
            "states": [code for code, _ in groupby(codes)],
            "losses": self.bench.losses,
            "unpaired": self.bench.pair.stream.report.unpaired,
        }


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of the drive in the order of its stamps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "monotonic", Clock())
        watched = Watched(tmp_path_factory.mktemp("calm") / "state", OracleWorker)
        for frame in sorted(chain(*streams().values()), key=lambda frame: frame.stamp_ns):
            watched.push(frame)
        watched.finish()
    return watched.reported


def may_come(stream: str, waiting: dict[str, deque[Frame]]) -> bool:
    """Whether the next frame of a stream may be the next of all: what is promised of streams, and no more."""
    if not waiting[stream]:
        return False
    stamp_ns = waiting[stream][0].stamp_ns
    others = {name: frames[0].stamp_ns for name, frames in waiting.items() if name != stream and frames}
    if any(stamp_ns > other_ns + 20 * NS_PER_S for other_ns in others.values()):
        return False  # what was sent before the vehicle was parked has come
    if stream == "ego":
        return True
    if "ego" in others and stamp_ns - others["ego"] > MOTION_LATE_NS - NS_PER_S // 2:
        return False
    return all(stamp_ns - others[name] <= AHEAD * NS_PER_S // 2 for name in ("camera", "lidar") if name in others)


def disturbed(folder: Path, seed: int, clock: Clock) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    watched = Watched(folder, SlowWorker)
    bench = watched.bench
    assert isinstance(bench.worker, SlowWorker)
    bench.worker.rng = rng
    waiting = streams()
    last_ns = 0
    favourite = "camera"
    while any(waiting.values()):
        if rng.random() < 0.05:
            favourite = str(rng.choice(list(waiting)))
        allowed = [name for name in waiting if may_come(name, waiting)]
        name = favourite if favourite in allowed else str(rng.choice(allowed))
        frame = waiting[name].popleft()
        if frame.stamp_ns - last_ns > 30 * NS_PER_S and last_ns:
            wait_in_silence(watched, clock)
        last_ns = max(last_ns, frame.stamp_ns)
        clock.now_s += rng.exponential(0.05)
        if rng.random() < 0.005:
            bench.worker.work(share=1.0)
            bench.settle()
            clock.now_s += STALL_S
            bench.check_clocks()
        watched.push(frame)
        bench.pair.tick(clock.now_s, waiting=False)
    watched.finish()
    assert "degraded" in [entry.code for entry in bench.entries("state")], "checks were overdue"
    return watched.reported


def wait_in_silence(watched: Watched, clock: Clock) -> None:
    """Nothing comes for much longer than any pause before; all that was asked is answered."""
    bench = watched.bench
    assert isinstance(bench.worker, SlowWorker)
    for _ in range(400):
        clock.now_s += STALL_S / 20
        bench.worker.work(share=0.5)
        bench.settle()
        bench.pair.tick(clock.now_s, waiting=False)
    assert isinstance(watched.windows[-1], SliceClosed), "silence ends the slice"


@pytest.mark.fault(
    "streams late and out of step, a slow worker, a stalling clock", "the same windows and checks, to the byte"
)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_whatever_the_machine_does_the_same_frames_make_the_same_decisions(
    tmp_path: Path, calm: dict[str, Any], seed: int, clock: Clock, record_property: Callable[[str, object], None]
) -> None:
    reported = disturbed(tmp_path / "disturbed", seed, clock)
    record_property("figure", f"{len(calm['looked'])} pairs, {len(calm['checks'])} checks, all equal")
    assert len(calm["checks"]) > 20
    assert {"suspect", "miscalibrated", "healthy"} <= set(calm["states"])
    for what in calm:
        assert reported[what] == calm[what], what
