"""What rmw_zenoh's publishers say beside each message, and what becomes of it."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat
from coec.config import LimitsConfig, PairConfig
from coec.io.logs import LossCounter
from coec.io.ros import message_encoding
from coec.io.zenoh.bus import InputSample
from coec.service.ingest.decoder import CAMERA, Decoder

PAIR = PairConfig.model_validate(
    {
        "name": "front",
        "camera": {
            "topic": "/front/image_raw",
            "intrinsics": {"model": "pinhole", "width": 4, "height": 3, "fx": 1, "fy": 1, "cx": 1, "cy": 1},
        },
        "lidar": "/top/points",
        "T_camera_lidar": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }
)
IMAGE = "application/cdr;sensor_msgs/msg/Image"
FRAME = CameraFrame(5, "camera", EncodedImage(ImageFormat.MONO8, 4, 3, bytes(12)))
SENT_NS = 1_763_800_000_123_456_789


def neighbour(number: int, sender: int = 1, source_ns: int = SENT_NS) -> bytes:
    """Packed by hand: number, wall clock, length of the id, id; little endian."""
    return number.to_bytes(8, "little") + source_ns.to_bytes(8, "little") + b"\x10" + bytes([sender]) * 16


def image(stamp_ns: int = 5) -> bytes:
    return message_encoding.encode_image(replace(FRAME, stamp_ns=stamp_ns))[1]


class Bench:
    def __init__(self) -> None:
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.decoder = Decoder(CAMERA, PAIR.camera, LimitsConfig(), self.losses)

    def sample(self, attachment: bytes, payload: bytes | None = None, encoding: str = IMAGE) -> InputSample:
        return InputSample(payload or image(), encoding, attachment)

    def take(self, attachment: bytes, payload: bytes | None = None, encoding: str = IMAGE) -> CameraFrame | None:
        frame = self.decoder.frame(self.sample(attachment, payload, encoding))
        assert frame is None or isinstance(frame, CameraFrame)
        return frame


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_gaps_in_the_numbers_of_a_publisher_are_loss(bench: Bench) -> None:
    assert all(bench.take(neighbour(number)) for number in (1, 2, 5, *range(6, 40)))
    assert bench.losses.snapshot() == {(CAMERA, "sequence_gap"): 2}


@pytest.mark.fault("a publisher of ROS that is started again", "no loss, and no second sender")
def test_a_publisher_that_is_started_again_is_a_new_one(bench: Bench) -> None:
    for sender in (1, 2):
        for number in range(1, 30):
            bench.take(neighbour(1000 * (2 - sender) + number, sender))
    assert bench.losses.snapshot() == {}
    assert bench.decoder.counts().taking_turns == ()


@pytest.mark.fault(
    "two publishers on one topic of ROS",
    "their losses are counted apart, health names them, and no frame of either is used until one ends",
)
def test_two_publishers_at_a_time_are_distinguished_until_one_ends(bench: Bench) -> None:
    for number in range(1, 11):
        bench.take(neighbour(number, 1))
        bench.take(neighbour(500 + number, 2))
    assert set(bench.decoder.counts().taking_turns) == {b"\1" * 16, b"\2" * 16}
    frames = [bench.take(neighbour(number, 1)) for number in range(11, 80)]
    assert not bench.decoder.counts().taking_turns
    assert (frames[0], frames[-1]) == (None, FRAME)
    assert set(bench.losses.snapshot()) == {(CAMERA, "two_senders")}


@pytest.mark.fault("a publisher whose numbers step back or are absurd", "frames are taken, no loss is invented")
@pytest.mark.parametrize("numbers", [(100, 1, 2), (1, 2**63 - 1, 2), (5, 5, 5)])
def test_numbers_that_make_no_sense_cost_nothing(bench: Bench, numbers: tuple[int, ...]) -> None:
    assert all(bench.take(neighbour(number)) for number in numbers)
    assert bench.losses.snapshot() == {}


@pytest.mark.fault(
    "bytes beside a message that are not rmw_zenoh's", "they are counted; the frame is taken all the same"
)
@pytest.mark.parametrize(
    "attachment",
    [b"", neighbour(1)[:-1], neighbour(1)[:16] + b"\x0f" + neighbour(1)[17:], b"\xff" * 33],
    ids=["empty", "short", "of another length", "negative"],
)
def test_what_is_no_attachment_is_counted_and_the_frame_taken(bench: Bench, attachment: bytes) -> None:
    assert bench.take(attachment) == FRAME
    assert bench.losses.snapshot() == {(CAMERA, "attachment_malformed"): 1}


def test_a_refused_message_is_no_gap(bench: Bench) -> None:
    for number in range(1, 40):
        bench.take(neighbour(number), b"rubbish" if number == 3 else None)
    assert bench.losses.snapshot() == {(CAMERA, "message_malformed"): 1}


def test_an_overrun_of_a_numbered_message_is_counted_once(bench: Bench) -> None:
    for number in range(1, 40):
        if number == 3:
            bench.decoder.overrun(bench.sample(neighbour(number)))
        else:
            bench.take(neighbour(number))
    assert bench.losses.snapshot() == {(CAMERA, "overrun"): 1}


def test_the_stamp_of_the_header_is_the_truth_and_the_senders_stands_in_for_none(bench: Bench) -> None:
    reported = []
    for number, stamp_ns in enumerate((5, 0, 7), 1):
        frame = bench.take(neighbour(number), image(stamp_ns))
        assert frame is not None
        reported.append((frame.stamp_ns, bench.decoder.counts().stamped_by_sender))
    assert reported == [(5, False), (SENT_NS, True), (7, False)]


def test_a_sender_without_a_clock_leaves_the_stamp_as_it_is(bench: Bench) -> None:
    bare = bench.take(neighbour(1, source_ns=0), image(stamp_ns=0))
    assert bare is not None
    assert bare.stamp_ns == 0


@pytest.mark.fault("another type under the same topic", "refused as `wrong_type`, and the log says what was expected")
def test_a_type_that_the_stream_does_not_take_is_refused_by_name(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    for number, type_name in enumerate(("sensor_msgs/msg/PointCloud2", "std_msgs/msg/String", "?"), 1):
        assert bench.take(neighbour(number), None, f"application/cdr;{type_name}") is None
    assert bench.losses.snapshot() == {(CAMERA, "wrong_type"): 3}
    assert "/front/image_raw: expected sensor_msgs/msg/CompressedImage or sensor_msgs/msg/Image" in caplog.text
