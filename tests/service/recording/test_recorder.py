"""The recorder: windows appear whole or not at all, faults cost a window only, what was left behind is looked after."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import queue
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from coec.calibration.frames.window import CarriedOverPairs, SliceClosed
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import CalibrationConfig, StateConfig
from coec.errors import RecordingError
from coec.geometry.cameras import build
from coec.io.logs import LossCounter
from coec.io.mcap.windows import WindowWriter, read_window
from coec.service.recording.recorder import (
    BETWEEN_WAITING,
    PAIRS_WAITING,
    STUCK_S,
    UNSOLVED_RESUMED,
    RecordBetween,
    Recorder,
    RecordingPlan,
    RecordingThread,
    RecordPair,
    WindowLost,
    WindowRecorded,
)
from coec.service.recording.window_store import WindowStore
from support.fake_worker import wait_until

DEADLINE_S = 20.0
MIN_PAIRS = 2
NOMINAL = np.eye(4)
IMAGE = EncodedImage(ImageFormat.MONO8, 4, 3, bytes(range(12)))
RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    NOMINAL,
    NOMINAL,
)
PLAN = RecordingPlan(RIG, CalibrationConfig(), MIN_PAIRS, {"vehicle": "test"})

Recorded = tuple[str, Path, bool]


def pair(stamp_ns: int, points: int = 10) -> FramePair:
    cloud = np.arange(3 * points, dtype=np.float32).reshape(points, 3)
    return FramePair(CameraFrame(stamp_ns, "camera", IMAGE), LidarFrame(stamp_ns, "lidar", cloud))


def store_of(path: Path, **limits: Any) -> WindowStore:
    return WindowStore(path / "windows", StateConfig(**{"min_free_bytes": 0, **limits}))


class Bench:
    """A recorder that is not started yet, and what it reports."""

    def __init__(self, store: WindowStore, plan: RecordingPlan = PLAN) -> None:
        self.store = store
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.recorded: queue.SimpleQueue[Recorded] = queue.SimpleQueue()
        self.lost: list[str] = []
        self.recording = RecordingThread()
        self.recorder = Recorder(plan, store, self.losses, self.recording, self.post)
        self.recording.join(self.recorder)

    def post(self, pair: str, event: WindowRecorded | WindowLost) -> None:
        """What the engine does, but for the solve."""
        assert pair == "front"
        if isinstance(event, WindowLost):
            self.lost.append(event.window_id)
        else:
            self.store.release(event.window_id)
            self.recorded.put((event.window_id, event.path, event.live))

    @contextmanager
    def running(self) -> Iterator[Recorder]:
        self.recording.thread.start()
        try:
            yield self.recorder
        finally:
            self.stop()

    def stop(self) -> None:
        self.recording.request_stop()
        assert self.recording.thread.join(DEADLINE_S)
        assert self.recording.thread.failure is None

    def window(self, name: str, stamps: list[int]) -> None:
        for stamp_ns in stamps:
            self.recorder.add(RecordPair(name, pair(stamp_ns), NOMINAL))
        self.recorder.end(SliceClosed(name, len(stamps), len(stamps) >= MIN_PAIRS))

    def files(self) -> list[str]:
        return sorted(path.name for path in self.store.path("x").parent.iterdir())


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(store_of(tmp_path))


def test_a_window_is_written_and_reported(bench: Bench) -> None:
    with bench.running():
        bench.window("front-10", [10, 20, 30])
        window_id, path, live = bench.recorded.get(timeout=DEADLINE_S)
        assert (window_id, live) == ("front-10", True)
        window, _ = read_window(path)
        assert [p.stamp_ns for p in window.pairs] == [10, 20, 30]
        (info,) = bench.store.listing("front")
        assert (info.window_id, info.pairs, info.decision) == ("front-10", 3, None)
        assert info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert bench.files() == ["front-10.mcap"]
    assert bench.recorder.latest == path


def test_a_window_is_calibrated_by_what_held_when_it_began(bench: Bench) -> None:
    later = CalibrationConfig(motion_compensation=False)
    bench.recorder.add(RecordPair("front-10", pair(10), NOMINAL))
    bench.recorder.reconfigure(later)
    bench.recorder.add(RecordPair("front-10", pair(20), NOMINAL))
    bench.recorder.end(SliceClosed("front-10", 2, True))
    bench.window("front-30", [30, 40])
    with bench.running():
        paths = [bench.recorded.get(timeout=DEADLINE_S)[1] for _ in range(2)]
        assert [read_window(path)[1] for path in paths] == [CalibrationConfig(), later]


def metadata_of(path: Path) -> dict[str, str]:
    """What a window says of where it comes from."""
    result: dict[str, str] = {}
    with path.open("rb") as stream:
        for record in make_reader(stream).iter_metadata():
            result |= record.metadata
    return result


def test_a_window_says_by_which_settings_it_was_taken(bench: Bench) -> None:
    """Those of its first pair, also where others came while it was open: it still takes as many as they asked for."""
    first, then = (replace(PLAN, metadata={"settings_hash": name}) for name in ("first", "then"))
    bench.recorder.follow(first)
    with bench.running():
        bench.recorder.add(RecordPair("front-10", pair(10), NOMINAL))
        wait_until(lambda: bench.recorder.waiting == 0 and bench.files() != [], "the first pair")
        bench.recorder.follow(replace(then, min_pairs=3))
        bench.window("front-10", [20])
        _, path, _ = bench.recorded.get(timeout=DEADLINE_S)
        assert metadata_of(path)["settings_hash"] == "first"
        bench.window("front-50", [50, 60, 70])
        _, path, _ = bench.recorded.get(timeout=DEADLINE_S)
        assert metadata_of(path)["settings_hash"] == "then"


def test_too_few_pairs_leave_no_file(bench: Bench) -> None:
    with bench.running():
        bench.window("front-10", [10])
        bench.window("front-50", [50, 60])
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-50"
    assert bench.files() == ["front-50.mcap"]
    assert bench.losses.snapshot() == {("window", "too_few_pairs"): 1}
    assert bench.lost == ["front-10"]


def test_a_window_takes_what_an_earlier_one_keeps_for_it_from_the_disk(bench: Bench) -> None:
    retained = CarriedOverPairs("front-10", 20, 30, 2)
    with bench.running():
        bench.window("front-10", [10, 20, 30])
        bench.recorder.add(RecordPair("front-50", pair(50), NOMINAL))
        bench.recorder.end(SliceClosed("front-50", 3, True, retained))
        names = [bench.recorded.get(timeout=DEADLINE_S)[0] for _ in range(2)]
        assert names == ["front-10", "front-50"]
    window, _ = read_window(bench.store.path("front-50"))
    assert [p.stamp_ns for p in window.pairs] == [20, 30, 50]
    assert bench.losses.snapshot() == {}


def test_pairs_between_are_recorded_next_to_those_of_the_open_window_and_do_not_count(bench: Bench) -> None:
    with bench.running():
        bench.recorder.add(RecordBetween("front-10", pair(5)))
        bench.recorder.add(RecordPair("front-10", pair(10), NOMINAL))
        bench.recorder.add(RecordBetween("front-10", pair(15)))
        bench.recorder.add(RecordPair("front-10", pair(20), NOMINAL))
        bench.recorder.add(RecordBetween("front-10", pair(25)))
        bench.recorder.end(SliceClosed("front-10", 2, True))
        bench.recorder.add(RecordPair("front-40", pair(40), NOMINAL))
        bench.recorder.add(RecordBetween("front-40", pair(45)))
        bench.recorder.end(SliceClosed("front-40", 1, False))
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-10"
    window, _ = read_window(bench.store.path("front-10"))
    assert [one.stamp_ns for one in window.pairs] == [10, 20]
    assert [one.stamp_ns for one in window.between] == [15, 25]
    assert bench.lost == ["front-40"], "pairs between make no window"


@pytest.mark.fault(
    "a window is gone whose last pairs the next window is to hold", "the loss is counted, the next is kept"
)
def test_retained_pairs_that_are_gone_are_counted_and_cost_no_window(bench: Bench) -> None:
    with bench.running():
        for name, stamps in (("front-50", [50, 60]), ("front-70", [70])):
            for stamp_ns in stamps:
                bench.recorder.add(RecordPair(name, pair(stamp_ns), NOMINAL))
            bench.recorder.end(SliceClosed(name, len(stamps) + 3, True, CarriedOverPairs("front-10", 20, 30, 3)))
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-50"
    assert bench.files() == ["front-50.mcap"]
    assert bench.lost == ["front-70"], "without them it is none"
    assert bench.losses.snapshot() == {("window", "kept_pairs_lost"): 6, ("window", "too_few_pairs"): 1}


def test_a_stop_finishes_the_open_window(bench: Bench) -> None:
    for stamp_ns in (10, 20):
        bench.recorder.add(RecordPair("front-10", pair(stamp_ns), NOMINAL))
    with bench.running():
        pass
    assert bench.files() == ["front-10.mcap"]
    assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-10"


def test_a_stop_abandons_an_open_window_with_too_few_pairs(bench: Bench) -> None:
    bench.recorder.add(RecordPair("front-10", pair(10), NOMINAL))
    with bench.running():
        pass
    assert bench.files() == []


@pytest.mark.fault("a disk too slow for what is recorded", "pairs beyond the queue are counted, and the window ends")
def test_pairs_beyond_the_queue_are_counted_and_the_end_still_comes(bench: Bench) -> None:
    bench.window("front-1", list(range(1, PAIRS_WAITING + 4)))
    with bench.running():
        _, path, _ = bench.recorded.get(timeout=DEADLINE_S)
    assert len(read_window(path)[0].pairs) == PAIRS_WAITING
    assert bench.losses.snapshot() == {("window", "recorder_overrun"): 3}


def test_pairs_between_take_no_place_of_those_of_a_window_in_the_queue(bench: Bench) -> None:
    bench.recorder.add(RecordPair("front-1", pair(1), NOMINAL))
    for stamp_ns in range(2, 2 + BETWEEN_WAITING):
        assert bench.recorder.has_room
        bench.recorder.add(RecordBetween("front-1", pair(stamp_ns)))
    assert not bench.recorder.has_room, "the stream waits, and a replay at any rate records the same"
    assert bench.recorder.waiting == 1
    bench.recorder.add(RecordBetween("front-1", pair(100)))
    assert bench.losses.snapshot() == {("window", "recorder_overrun"): 1}
    bench.recorder.add(RecordPair("front-1", pair(200), NOMINAL))
    bench.recorder.end(SliceClosed("front-1", 2, True))
    with bench.running():
        _, path, _ = bench.recorded.get(timeout=DEADLINE_S)
        assert bench.recorder.has_room
    window, _ = read_window(path)
    assert (len(window.pairs), len(window.between)) == (2, BETWEEN_WAITING)


@pytest.mark.fault("the disk becomes full while a window is recorded", "it costs one window, and the next is tried")
def test_a_full_disk_costs_one_window_and_the_next_is_tried(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    real = WindowWriter.add

    def failing(self: WindowWriter, item: FramePair) -> None:
        if item.stamp_ns == 20:
            self.abandon()
            raise RecordingError("no space left on device")
        real(self, item)

    monkeypatch.setattr(WindowWriter, "add", failing)
    with bench.running() as recorder:
        bench.window("front-10", [10, 20, 30])
        wait_until(lambda: recorder.problem is not None, "the trouble")
        assert recorder.problem is not None
        assert "no space left" in recorder.problem.text
        bench.window("front-50", [50, 60])
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-50"
        assert recorder.problem is None
    assert bench.losses.snapshot() == {("window", "recording_failed"): 1}
    assert bench.files() == ["front-50.mcap"]
    assert bench.lost == ["front-10"]


@pytest.mark.fault("a disk that is nearly full", "no window begins below the free space asked for")
def test_no_window_starts_below_the_free_space_requested(tmp_path: Path) -> None:
    bench = Bench(store_of(tmp_path, min_free_bytes=2**62))
    with bench.running():
        bench.window("front-10", [10, 20])
    assert bench.files() == []
    assert bench.losses.snapshot() == {("window", "recording_failed"): 1}


@pytest.mark.fault("windows that a killed service left behind", "they are salvaged and solved, the newest first")
def test_leftovers_are_salvaged_and_unsolved_windows_resumed_newest_first(tmp_path: Path) -> None:
    folder = store_of(tmp_path)
    for start in range(100, 100 * (UNSOLVED_RESUMED + 2), 100):
        writer = WindowWriter(folder.path(f"front-{start}"), RIG, NOMINAL, f"front-{start}", CalibrationConfig(), {})
        writer.add(pair(start))
        writer.add(pair(start + 1))
        writer.finish()
    whole, short = (folder.path(name) for name in ("front-900", "front-950"))
    for path, stamps in ((whole, [900, 901, 902]), (short, [950])):
        writer = WindowWriter(path, RIG, NOMINAL, path.stem, CalibrationConfig(), {})
        for stamp_ns in stamps:
            writer.add(pair(stamp_ns, points=10_000))
        part = path.with_name(f"{path.name}.part")
        killed_here = part.read_bytes()
        writer.abandon()
        part.write_bytes(killed_here)
    folder.path("front-990").with_name("front-990.mcap.part").write_bytes(b"nonsense")
    bench = Bench(folder)
    with bench.running():
        resumed = [bench.recorded.get(timeout=DEADLINE_S) for _ in range(UNSOLVED_RESUMED)]
    assert [name for name, _, _ in resumed] == ["front-900", "front-500", "front-400", "front-300"]
    assert not any(live for _, _, live in resumed)
    assert bench.recorded.empty()
    assert not [name for name in bench.files() if name.endswith(".part")]
    assert "front-950.mcap" not in bench.files()
    assert bench.losses.snapshot()["window", "too_few_pairs_salvaged"] == 2


@pytest.mark.fault("a disk that refuses a window", "health says why until one can be written again")
def test_problem_is_reported_in_the_text_of_the_disk_until_what_follows_can_be_written(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.fdatasync

    def refusing(_descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with bench.running() as recorder:
        monkeypatch.setattr(os, "fdatasync", refusing)
        bench.window("front-10", [10, 20])
        wait_until(lambda: bench.lost == ["front-10"], "the loss")
        assert recorder.problem is not None
        assert recorder.problem.code == "recording_failed"
        assert "Input/output error" in recorder.problem.text
        assert bench.files() == []
        monkeypatch.setattr(os, "fdatasync", real)
        bench.window("front-50", [50])  # too short to be kept, but what there was of it went to the disk
        wait_until(lambda: bench.lost == ["front-10", "front-50"], "the end of the second window")
        assert recorder.problem is None


def test_a_window_cannot_be_removed_while_it_is_handed_over(tmp_path: Path) -> None:
    bench = Bench(store_of(tmp_path, min_free_bytes=2**62))
    posted: queue.SimpleQueue[WindowRecorded] = queue.SimpleQueue()

    def post(pair: str, event: WindowRecorded | WindowLost) -> None:
        del pair
        assert isinstance(event, WindowRecorded)
        posted.put(event)

    writer = WindowWriter(bench.store.path("front-10"), RIG, NOMINAL, "front-10", CalibrationConfig(), {})
    writer.add(pair(10))
    writer.finish()
    recording = RecordingThread()
    recording.join(Recorder(PLAN, bench.store, bench.losses, recording, post))
    recording.thread.start()
    event = posted.get(timeout=DEADLINE_S)
    recording.request_stop()
    assert recording.thread.join(DEADLINE_S)
    path = event.path
    bench.store.path("front-999").write_bytes(b"later")  # so that it is not the latest
    with suppress(RecordingError):
        bench.store.make_room(lambda: None)
    assert path.exists()
    bench.store.release(event.window_id)
    with pytest.raises(RecordingError):
        bench.store.make_room(lambda: None)
    assert not path.exists()


def test_windows_that_nobody_reported_are_read_next_to_the_work(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    for start in (100, 200):
        writer = WindowWriter(store.path(f"front-{start}"), RIG, NOMINAL, f"front-{start}", CalibrationConfig(), {})
        writer.add(pair(start, points=600_000))  # more than is read in one round
        writer.finish()
    bench = Bench(store)
    store.scan()
    assert [info.sha256 for info in store.listing("front")] == [None, None]
    with bench.running():
        wait_until(lambda: not store.unread("front"), "the digests")
        bench.window("front-300", [300, 301])
        wait_until(lambda: bench.recorder.recorded == 1, "a window")
    for info in store.listing("front"):
        assert info.sha256 == hashlib.sha256(store.path(info.window_id).read_bytes()).hexdigest()


@pytest.mark.fault("the service is stopped while gigabytes are hashed", "it does not wait for that")
def test_a_stop_does_not_wait_for_windows_that_are_being_read(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    store.path("front-1").write_bytes(bytes(64 * 2**20))
    bench = Bench(store)
    with bench.running():
        pass
    assert store.unread("front") == ("front-1",)


@pytest.mark.fault("a disk that never lets go of the recorder", "this is reported, and the stop goes on")
def test_a_thread_that_the_disk_does_not_let_go_is_reported(tmp_path: Path) -> None:
    recorder = Bench(store_of(tmp_path)).recorder
    assert recorder.problem is None
    recorder._thread._beat_s -= STUCK_S + 1.0  # since the last sign of life
    assert recorder.problem is not None
    assert (recorder.problem.code, "3 s" in recorder.problem.text) == ("recording_stuck", True)
    recorder._thread.beat()
    assert recorder.problem is None
