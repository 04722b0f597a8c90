"""Pairs that wait are bounded in bytes and in time."""

from __future__ import annotations

import numpy as np

from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame
from coec.service.ingest.pair_stream import PairBuffer, WaitingFrames, frame_bytes

IMAGE = EncodedImage(ImageFormat.MONO8, 4, 2, bytes(8))


def pair(stamp_ns: int) -> FramePair:
    cloud = LidarFrame(stamp_ns, "lidar", np.zeros((10, 3), np.float32), ring=np.zeros(10, np.uint16))
    return FramePair(CameraFrame(stamp_ns, "camera", IMAGE, depth=IMAGE), cloud)


def bytes_of(one: FramePair) -> int:
    return frame_bytes(one.camera) + frame_bytes(one.lidar)


def test_bytes_are_those_of_images_and_points() -> None:
    assert bytes_of(pair(0)) == 8 + 8 + 120 + 20


def test_the_oldest_goes_first_and_waits_for_so_many_seconds_and_bytes() -> None:
    held = PairBuffer(WaitingFrames(3 * bytes_of(pair(0)), lambda: False), max_wait_s=10.0)
    for stamp_ns in (1, 2, 3):
        held.add(pair(stamp_ns))
    assert not held.has_waited(100.0)
    assert not held.has_waited(110.0)
    assert held.has_waited(110.5)
    held.stop_waiting()
    assert not held.has_waited(111.0)
    held.add(pair(4))
    assert held.has_waited(111.0)
    assert (held.pairs[0].stamp_ns, held.take().stamp_ns, len(held.pairs)) == (1, 1, 3)
    assert not held.has_waited(111.0)


def test_a_frame_of_several_pairs_counts_once() -> None:
    first, second = pair(1), pair(1)
    shared = FramePair(second.camera, first.lidar)
    frames = WaitingFrames(bytes_of(first) + frame_bytes(second.camera), lambda: False)
    one, other = PairBuffer(frames, 10.0), PairBuffer(frames, 10.0)
    one.add(first)
    other.add(shared)
    assert not one.has_waited(0.0)
    assert not other.has_waited(0.0)
    assert one.take() is first
    other.add(first)
    assert not other.has_waited(0.0), "the same three frames"
    other.add(second)
    assert other.has_waited(0.0)


def test_who_waits_for_long_pushes_nobody_else_on() -> None:
    frames = WaitingFrames(3 * bytes_of(pair(0)), lambda: False)
    late, prompt = PairBuffer(frames, 10.0), PairBuffer(frames, 10.0)
    for stamp_ns in (1, 2, 3):
        late.add(pair(stamp_ns))
    prompt.add(pair(4))
    assert not prompt.has_waited(0.0)
    assert late.has_waited(0.0)
    late.take()
    assert not late.has_waited(0.0)
