"""A disk that refuses at every point of a window's life: it costs that window, and is told; the next one is whole."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import CalibrationConfig, StateConfig
from coec.geometry.cameras import build
from coec.io.logs import LossCounter
from coec.io.mcap.windows import read_window
from coec.service.recording.recorder import (
    Recorder,
    RecordingPlan,
    RecordingThread,
    RecordPair,
    WindowLost,
    WindowRecorded,
)
from coec.service.recording.window_store import WindowStore
from support.disk import FullDisk
from support.fake_worker import wait_until

NOMINAL = np.eye(4)
RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    NOMINAL,
    NOMINAL,
)
PLAN = RecordingPlan(RIG, CalibrationConfig(), 2, {"vehicle": "test"})


def pair(stamp_ns: int) -> FramePair:
    image = EncodedImage(ImageFormat.MONO8, 4, 3, bytes(range(12)))
    cloud = np.arange(30, dtype=np.float32).reshape(10, 3)
    return FramePair(CameraFrame(stamp_ns, "camera", image), LidarFrame(stamp_ns, "lidar", cloud))


class Life:
    """A recorder, and what it says of the windows that it is given."""

    def __init__(self, folder: Path) -> None:
        self.store = WindowStore(folder / "windows", StateConfig(min_free_bytes=0))
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.recorded: list[str] = []
        self.lost: list[str] = []
        self.recording = RecordingThread()
        self.recorder = Recorder(PLAN, self.store, self.losses, self.recording, self.post)
        self.recording.join(self.recorder)
        self.recording.thread.start()

    def post(self, pair: str, event: WindowRecorded | WindowLost) -> None:
        del pair
        (self.recorded if isinstance(event, WindowRecorded) else self.lost).append(event.window_id)

    def window(self, start_ns: int) -> bool:
        """Whether a window of three pairs came to the disk; every window comes to one end."""
        name, before = f"front-{start_ns}", len(self.recorded) + len(self.lost)
        for stamp_ns in range(start_ns, start_ns + 3):
            self.recorder.add(RecordPair(name, pair(stamp_ns), NOMINAL))
        self.recorder.end(SliceClosed(name, 3, True))
        wait_until(lambda: len(self.recorded) + len(self.lost) > before, "the end of the window")
        return name in self.recorded

    def stop(self) -> None:
        self.recording.request_stop()
        assert self.recording.thread.join(20.0)
        assert self.recording.thread.failure is None


@pytest.mark.fault(
    "a disk that is full or read-only at any write, fsync or rename of a window's life",
    "that window is whole, or lost and reported; the next one is whole, and no half file is left",
)
@pytest.mark.parametrize(
    ("error", "length"),
    [
        (errno.ENOSPC, 1),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((errno.ENOSPC, 1000), (errno.EROFS, 1000))),
    ],
)
def test_a_disk_that_refuses_at_any_point_costs_that_window_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Any, error: int, length: int
) -> None:
    first, points, refused = 0, 0, True
    while refused:
        folder = tmp_path / str(first)
        with monkeypatch.context() as patch:
            life = Life(folder)
            disk = FullDisk(folder, patch, error)
            disk.refuses = range(first, first + length)
            whole = life.window(10)
            refused = disk.operations > first
            problem = life.recorder.problem
            disk.refuses = ()
            assert life.window(50), f"the next window, after operation {first}"
            assert life.recorder.problem is None
            life.stop()
        assert whole or (problem is not None and os.strerror(error) in problem.text)
        assert whole or not refused or life.losses.snapshot()["window", "recording_failed"] == 1
        assert life.lost == ([] if whole else ["front-10"])
        again = WindowStore(folder / "windows", StateConfig(min_free_bytes=0))
        for path in again.windows("front"):
            assert len(read_window(path)[0].pairs) == 3
        assert {path.stem for path in again.windows("front")} >= set(life.recorded)
        points += 1
        first += 1
    assert points > 15
    record_property("figure", f"{points} points")
