"""A recorder in a process of its own, as fast as its disk, until it is killed: `FOLDER LIFE`. What is on the disk is
said on standard output, a line each: `window ID SHA256` or `snippet ID SHA256`."""

from __future__ import annotations

import itertools
import logging
import sys
from pathlib import Path

import numpy as np

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import CalibrationConfig, StateConfig
from coec.geometry.cameras import build
from coec.io.logs import LossCounter
from coec.service.ingest.pair_stream import Snippet
from coec.service.recording.recorder import Recorder, RecordingPlan, RecordingThread, RecordPair
from coec.service.recording.snippets import SnippetRecorder, SnippetStore
from coec.service.recording.window_store import WindowStore
from support.fake_worker import wait_until

NOMINAL = np.eye(4)
CAMERA = build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0)
RIG = Rig("front", CAMERA, "camera", "lidar", NOMINAL, NOMINAL)
PLAN = RecordingPlan(RIG, CalibrationConfig(), 2, {"vehicle": "test"}, packed=True)
PAIRS, POINTS = 4, 30_000
"""Of a window; 1.5 MB of it are packed."""

S = 1_000_000_000


def pair(stamp_ns: int) -> FramePair:
    rng = np.random.default_rng(stamp_ns)
    cloud = np.round(rng.normal(size=(POINTS, 3)), 2).astype(np.float32)
    image = EncodedImage(ImageFormat.MONO8, 4, 3, bytes(range(12)))
    return FramePair(CameraFrame(stamp_ns, "camera", image), LidarFrame(stamp_ns, "lidar", cloud))


def stores(folder: Path) -> tuple[WindowStore, SnippetStore]:
    limits = StateConfig(min_free_bytes=0, max_bytes=2**40)
    return WindowStore(folder / "windows", limits), SnippetStore(folder / "snippets", 2**40, 0)


def recorder_of(
    windows: WindowStore, snippets: SnippetStore, recorded: list[str]
) -> tuple[RecordingThread, Recorder, SnippetRecorder, LossCounter]:
    losses = LossCounter(logging.getLogger("test"), "front")
    neighbour = SnippetRecorder(RIG, {"vehicle": "test"}, snippets, losses, packed=True)
    recording = RecordingThread()
    recorder = Recorder(PLAN, windows, losses, recording, lambda _, event: recorded.append(event.window_id), neighbour)
    recording.join(recorder)
    return recording, recorder, neighbour, losses


def run(folder: Path, life: int) -> None:
    windows, snippets = stores(folder)
    finished: list[str] = []
    recording, recorder, neighbour, _ = recorder_of(windows, snippets, finished)
    recording.thread.start()
    reported: set[str] = set()
    for number in itertools.count(1):
        begin_ns = (1_700_000_000 + life * 1_000_000 + number * 10) * S
        name, before = f"front-{begin_ns}", len(finished)
        pairs = [pair(begin_ns + index) for index in range(PAIRS)]
        for one in pairs:
            recorder.add(RecordPair(name, one, NOMINAL))
        recorder.end(SliceClosed(name, PAIRS, True))
        neighbour.submit(
            Snippet("suspect", begin_ns, NOMINAL, tuple(frame for one in pairs for frame in (one.lidar, one.camera)))
        )
        wait_until(lambda: len(finished) > before, "the end of the window")  # noqa: B023 - called at once
        for info in windows.listing("front"):
            if info.window_id not in reported and info.sha256 is not None:
                reported.add(info.window_id)
                print(f"window {info.window_id} {info.sha256}", flush=True)
        for snippet in snippets.listing("front"):
            if snippet.snippet_id not in reported:
                reported.add(snippet.snippet_id)
                print(f"snippet {snippet.snippet_id} {snippet.sha256}", flush=True)


if __name__ == "__main__":
    run(Path(sys.argv[1]), int(sys.argv[2]))
