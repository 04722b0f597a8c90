"""How many files a reader has to enter to follow what becomes of one camera frame, one sweep and one motion."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import coec
from coec.io.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.io.zenoh.bus import MSGPACK, InputSample
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR
from support.vehicles import BEGIN_S, NS_PER_S, PairBench, frame_pair_at

MOST_FILES, MOST_MOVES = 14, 60

PACKAGE = str(Path(coec.__file__).parent)


class Trace:
    """Files of `coec` in the order in which their functions are called; calls within a file are one entry."""

    def __init__(self) -> None:
        self.files: list[str] = []
        self.calls = 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or not frame.f_code.co_filename.startswith(PACKAGE):
            return
        self.calls += 1
        name = frame.f_code.co_filename[len(PACKAGE) + 1 :]
        if not self.files or self.files[-1] != name:
            self.files.append(name)


def traced(bench: PairBench, stamp_ns: int) -> Trace:
    """A triple comes as bytes, and the engine does all that it may. The test's encoding is left out."""
    pair, trace = frame_pair_at(stamp_ns), Trace()
    assert pair.motion is not None
    packed = {EGO: encode_ego(pair.motion), LIDAR: encode_lidar(pair.lidar), CAMERA: encode_camera(pair.camera)}
    for kind, payload in packed.items():
        sample, put = InputSample(payload, MSGPACK), bench.vehicle.inbox.receiver(bench.pair.sensors[kind].number)
        before = sys.getprofile()
        sys.setprofile(trace)
        put(sample)
        bench.vehicle.turn(0.0)
        while bench.vehicle.is_busy:
            bench.vehicle.turn(0.0)
        sys.setprofile(before)
    return trace


def test_an_uneventful_triple_enters_few_files(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    bench = PairBench(tmp_path / "state")
    stamps = [BEGIN_S * NS_PER_S + number * NS_PER_S // 10 for number in range(66)]
    quiet = min([traced(bench, stamp_ns) for stamp_ns in stamps][60:], key=lambda trace: len(trace.files))
    files, moves = sorted(set(quiet.files)), len(quiet.files) - 1
    record_property("figure", f"{len(files)} files, {moves} moves, {quiet.calls} calls")
    assert len(files) <= MOST_FILES, files
    assert moves <= MOST_MOVES
