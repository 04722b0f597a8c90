"""The recorder: windows appear whole or not at all, faults cost a window only, what was left behind is looked after."""

from __future__ import annotations

import logging
import os
import queue
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.adapters.mcap.windows import WindowWriter, read_window
from coec.adapters.system.logs import LossCounter
from coec.calibration.frames.window import SliceEnded
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import CalibrationConfig, StateConfig
from coec.errors import NotFoundError, RecordingError, UsageError
from coec.geometry.cameras import build
from coec.runtime.recording import window_store
from coec.runtime.recording.recorder import PAIRS_WAITING, UNSOLVED_RESUMED, Recorder, RecordingPlan
from coec.runtime.recording.window_store import WindowFolder
from fakes import wait_until

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


def folder_of(path: Path, **limits: Any) -> WindowFolder:
    return WindowFolder(path / "windows", StateConfig(**{"min_free_bytes": 0, **limits}))


class Bench:
    """A recorder that is not started yet, and what it reports."""

    def __init__(self, folder: WindowFolder, plan: RecordingPlan = PLAN) -> None:
        self.folder = folder
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.recorded: queue.SimpleQueue[Recorded] = queue.SimpleQueue()
        self.lost: list[str] = []
        self.recorder = Recorder(plan, folder, self.losses, lambda *event: self.recorded.put(event), self.lost.append)

    @contextmanager
    def running(self) -> Iterator[Recorder]:
        self.recorder.thread.start()
        try:
            yield self.recorder
        finally:
            self.stop()

    def stop(self) -> None:
        self.recorder.request_stop()
        assert self.recorder.thread.join(DEADLINE_S)
        assert self.recorder.thread.failure is None

    def window(self, name: str, stamps: list[int]) -> None:
        for stamp_ns in stamps:
            self.recorder.add(name, pair(stamp_ns), NOMINAL)
        self.recorder.end(SliceEnded(name, len(stamps), len(stamps) >= MIN_PAIRS))

    def files(self) -> list[str]:
        return sorted(path.name for path in self.folder.path("x").parent.iterdir())


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(folder_of(tmp_path))


def test_a_window_is_written_and_reported(bench: Bench) -> None:
    with bench.running():
        bench.window("front-10", [10, 20, 30])
        window_id, path, live = bench.recorded.get(timeout=DEADLINE_S)
        assert (window_id, live) == ("front-10", True)
        window, _ = read_window(path)
        assert [p.stamp_ns for p in window.pairs] == [10, 20, 30]
        (info,) = bench.folder.listing("front")
        assert (info.window_id, info.pairs, info.decision) == ("front-10", 3, None)
    assert bench.files() == ["front-10.mcap"]
    assert bench.recorder.latest == path


def test_too_few_pairs_leave_no_file(bench: Bench) -> None:
    with bench.running():
        bench.window("front-10", [10])
        bench.window("front-50", [50, 60])
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-50"
    assert bench.files() == ["front-50.mcap"]
    assert bench.losses.snapshot() == {("window", "too_few_pairs"): 1}
    assert bench.lost == ["front-10"]


def test_a_stop_finishes_the_open_window(bench: Bench) -> None:
    for stamp_ns in (10, 20):
        bench.recorder.add("front-10", pair(stamp_ns), NOMINAL)
    with bench.running():
        pass
    assert bench.files() == ["front-10.mcap"]
    assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-10"


def test_a_stop_abandons_an_open_window_with_too_few_pairs(bench: Bench) -> None:
    bench.recorder.add("front-10", pair(10), NOMINAL)
    with bench.running():
        pass
    assert bench.files() == []


def test_pairs_beyond_the_queue_are_counted_and_the_end_still_comes(bench: Bench) -> None:
    bench.window("front-1", list(range(1, PAIRS_WAITING + 4)))
    with bench.running():
        _, path, _ = bench.recorded.get(timeout=DEADLINE_S)
    assert len(read_window(path)[0].pairs) == PAIRS_WAITING
    assert bench.losses.snapshot() == {("window", "recorder_overrun"): 3}


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
        wait_until(lambda: recorder.trouble is not None, "the trouble")
        assert recorder.trouble is not None
        assert "no space left" in recorder.trouble.text
        bench.window("front-50", [50, 60])
        assert bench.recorded.get(timeout=DEADLINE_S)[0] == "front-50"
        assert recorder.trouble is None
    assert bench.losses.snapshot() == {("window", "recording_failed"): 1}
    assert bench.files() == ["front-50.mcap"]
    assert bench.lost == ["front-10"]


def test_no_window_starts_below_the_free_space_asked_for(tmp_path: Path) -> None:
    bench = Bench(folder_of(tmp_path, min_free_bytes=2**62))
    with bench.running():
        bench.window("front-10", [10, 20])
    assert bench.files() == []
    assert bench.losses.snapshot() == {("window", "recording_failed"): 1}


def test_leftovers_are_salvaged_and_unsolved_windows_resumed_newest_first(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
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


# --- the folder --------------------------------------------------------------------------------------------------


def put(folder: WindowFolder, name: str, size: int, age_s: float) -> Path:
    path = folder.path(name)
    path.write_bytes(bytes(size))
    now_s = path.stat().st_mtime
    os.utime(path, (now_s - age_s, now_s - age_s))
    return path


def test_room_is_made_by_bytes_and_age_oldest_first(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, max_bytes=2**20, max_age_days=1.0)
    expired = put(folder, "front-1", 1000, 2 * 86_400)
    older = put(folder, "rear-2", 400_000, 3600)
    newer = put(folder, "front-3", 400_000, 60)
    folder.make_room()  # another 400 kB would not fit beside two
    assert not expired.exists()
    assert not older.exists()
    assert newer.exists()
    assert folder.removed == 2


def test_a_full_disk_takes_old_windows_but_not_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = folder_of(tmp_path, min_free_bytes=1000)
    old, new = put(folder, "front-1", 10, 60), put(folder, "front-2", 10, 30)
    monkeypatch.setattr(window_store, "_free_bytes", lambda _: 999)
    with pytest.raises(RecordingError, match="min_free_bytes"):
        folder.make_room()
    assert not old.exists()
    assert new.exists()


def test_pairs_whose_names_begin_alike_do_not_mix(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    put(folder, "front-1", 1, 0)
    put(folder, "front-left-2", 1, 0)
    assert [path.stem for path in folder.windows("front")] == ["front-1"]
    assert [path.stem for path in folder.windows("front-left")] == ["front-left-2"]


@pytest.mark.parametrize("window_id", ["../state", "front-1/..", "rear-1", "front-2", "front-1\0", "front-x", ""])
def test_only_the_pairs_own_windows_are_read(tmp_path: Path, window_id: str) -> None:
    folder = folder_of(tmp_path)
    put(folder, "front-1", 5, 0)
    put(folder, "rear-1", 5, 0)
    assert folder.read("front", "front-1", 3, 100) == bytes(2)
    with pytest.raises(NotFoundError):
        folder.read("front", window_id, 0, 1)
    with pytest.raises(UsageError, match="offset"):
        folder.read("front", "front-1", 6, 1)


def test_evidence_is_the_last_to_go_and_never_for_its_age(tmp_path: Path) -> None:
    path = tmp_path / "windows"
    path.mkdir()
    for name, age_days in (("front-1", 200), ("front-2", 200), ("front-3", 0)):
        (path / f"{name}.mcap").write_bytes(bytes(100_000))
        when = time.time() - 86_400 * age_days
        os.utime(path / f"{name}.mcap", (when, when))
    folder = folder_of(tmp_path, max_age_days=90.0)
    folder.protect("front", frozenset({"front-1"}))
    folder.make_room()
    assert sorted(file.stem for file in path.iterdir()) == ["front-1", "front-3"]
    (path / "front-4.mcap").write_bytes(bytes(700_000))
    full = folder_of(tmp_path, max_bytes=2**20)
    full.protect("front", frozenset({"front-1"}))
    full.make_room()
    assert sorted(file.stem for file in path.iterdir()) == ["front-1"]
    full.protect("front", frozenset())
