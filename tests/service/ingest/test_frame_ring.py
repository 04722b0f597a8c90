"""The last seconds at full rate: bounded whatever comes, and an event cuts out what lies around it."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Frame, ImageFormat, LidarFrame
from coec.config import SnippetsConfig
from coec.service.ingest.pair_stream import SILENT_S, FrameRing, Snippet, frame_bytes

S = 1_000_000_000
BEGIN_NS = 1_700_000_000 * S
POSE = np.eye(4)
IMAGE_BYTES = 1000
CONFIG = SnippetsConfig(before_s=4.0, after_s=2.0)


def camera(second: float, size: int = IMAGE_BYTES) -> CameraFrame:
    image = EncodedImage(ImageFormat.JPEG, 4, 3, bytes(size))
    return CameraFrame(BEGIN_NS + round(second * S), "camera", image)


def second_of(frame: Frame) -> float:
    return (frame.stamp_ns - BEGIN_NS) / S


class Bench:
    def __init__(self, max_bytes: int = 2**20) -> None:
        self.delivered: list[Snippet] = []
        self.ring = FrameRing(CONFIG, max_bytes, self.delivered.append)

    def drive(self, begin_s: int, end_s: int, size: int = IMAGE_BYTES) -> None:
        for second in range(begin_s, end_s):
            self.ring.push(camera(second, size), second)

    @property
    def seconds(self) -> list[float]:
        (snippet,) = self.delivered
        return [second_of(frame) for frame in snippet.frames]


def test_an_event_has_the_seconds_before_and_after_it_of_every_sensor() -> None:
    bench = Bench()
    cloud = np.zeros((10, 3), np.float32)
    for tick in range(40):
        stamp_ns = BEGIN_NS + tick * S // 2
        bench.ring.push(LidarFrame(stamp_ns, "lidar", cloud), tick / 2)
        bench.ring.push(EgoMotion(stamp_ns, "ego", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), tick / 2)
        bench.ring.push(camera(tick / 2), tick / 2)
        if tick == 20:
            bench.ring.event("suspect", POSE)
    (snippet,) = bench.delivered
    assert (snippet.event, snippet.stamp_ns, second_of(snippet.frames[0])) == ("suspect", BEGIN_NS + 10 * S, 6.0)
    assert second_of(snippet.frames[-1]) == 12.0
    assert [type(frame) for frame in snippet.frames] == [LidarFrame, EgoMotion, CameraFrame] * 13


def test_an_event_within_another_belongs_to_it_and_the_next_one_is_its_own() -> None:
    bench = Bench()
    bench.drive(0, 10)
    bench.ring.event("suspect", POSE)
    bench.drive(10, 11)
    bench.ring.event("miscalibrated", POSE)
    bench.drive(11, 20)
    assert [snippet.event for snippet in bench.delivered] == ["suspect"]
    bench.ring.event("degraded", POSE)
    bench.drive(20, 30)
    assert [snippet.event for snippet in bench.delivered] == ["suspect", "degraded"]
    first, second = ({second_of(frame) for frame in snippet.frames} for snippet in bench.delivered)
    assert first == {5, 6, 7, 8, 9, 10, 11}
    assert not first & second


@pytest.mark.fault("frames too large for the memory of a snippet", "it holds what fits, before and after the event")
def test_it_never_holds_more_than_its_bytes_and_leaves_half_for_what_comes() -> None:
    bench = Bench(max_bytes=8 * IMAGE_BYTES)
    held: list[int] = []
    for second in range(0, 100):
        bench.ring.push(camera(second / 10), second)
        held.append(bench.ring.bytes)
        if second == 50:
            bench.ring.event("suspect", POSE)
    assert max(held[:50]) == 4 * IMAGE_BYTES
    assert max(held) <= 8 * IMAGE_BYTES
    assert bench.seconds == pytest.approx([4.7, 4.8, 4.9, 5.0, 5.1, 5.2, 5.3, 5.4])
    assert sum(map(frame_bytes, bench.delivered[0].frames)) == 8 * IMAGE_BYTES


def test_one_frame_larger_than_everything_is_not_held() -> None:
    bench = Bench(max_bytes=1000)
    bench.drive(0, 3, size=5000)
    assert bench.ring.bytes == 0
    bench.ring.event("suspect", POSE)
    bench.ring.finish()
    assert bench.delivered == []


@pytest.mark.fault("sensor time steps back in the middle of an event", "its snippet ends, and a new one may begin")
def test_a_step_of_time_ends_what_is_open_and_forgets_what_was() -> None:
    bench = Bench()
    bench.drive(1000, 1010)
    bench.ring.event("suspect", POSE)
    bench.drive(0, 3)
    assert bench.seconds == [1005, 1006, 1007, 1008, 1009]
    bench.drive(2000, 2003)
    bench.ring.event("degraded", POSE)
    bench.ring.finish()
    assert [second_of(frame) for frame in bench.delivered[1].frames] == [2000, 2001, 2002]


def test_silence_ends_an_event() -> None:
    bench = Bench()
    bench.drive(0, 10)
    bench.ring.tick(100.0)
    bench.ring.event("stale", POSE)
    bench.ring.tick(9.0 + SILENT_S)
    assert bench.delivered == []
    bench.ring.tick(9.1 + SILENT_S)
    assert bench.seconds == [5, 6, 7, 8, 9]


def test_without_frames_there_is_nothing_to_keep() -> None:
    bench = Bench()
    bench.ring.event("degraded", POSE)
    bench.ring.finish()
    assert bench.delivered == []
