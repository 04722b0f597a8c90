"""What rmw_zenoh and its bridge put on the wire, written down byte by byte, as the service reads it."""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator

import pytest
import zenoh

from coec.config import Config, LimitsConfig, ZenohConfig
from coec.errors import UsageError
from coec.io.ros.wire_format import TopicKey
from coec.io.zenoh.bus import Bus, InputSample, input_of, open_session
from support.router import free_port

IMAGE = "0/front/image_raw/sensor_msgs::msg::dds_::Image_/"
IMAGE += "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
COMPRESSED = "0/front/image_raw/compressed/sensor_msgs::msg::dds_::CompressedImage_/"
COMPRESSED += "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a"
ATTACHMENT = bytes.fromhex("01000000000000000028d1a6c92a601810000102030405060708090a0b0c0d0e0f")
"""The first message of a publisher: its number, the wall clock, the length of its id, and the id."""

DEADLINE_S = 20.0


def configured(middleware: str, camera: object, **ros: object) -> Config:
    intrinsics = {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0}
    pair = {
        "name": "front",
        "camera": {**(camera if isinstance(camera, dict) else {"topic": camera}), "intrinsics": intrinsics},
        "lidar": {"key": "lidar"},
        "T_camera_lidar": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }
    return Config.model_validate({"middleware": middleware, "ros": ros, "pairs": [pair]})


@pytest.fixture(scope="module")
def session() -> Iterator[zenoh.Session]:
    config = ZenohConfig(embedded_router=True, listen=(f"tcp/127.0.0.1:{free_port()}",))
    with open_session(config, LimitsConfig()) as opened:
        yield opened


Received = Callable[[Config], "queue.SimpleQueue[InputSample]"]


@pytest.fixture
def received(session: zenoh.Session) -> Iterator[Received]:
    """Whatever the service hears of the camera, put by the same session: it comes before `put` returns."""
    bus = Bus(session)

    def listen(config: Config) -> queue.SimpleQueue[InputSample]:
        got: queue.SimpleQueue[InputSample] = queue.SimpleQueue()
        bus.subscribe(input_of(config.every_pair[0].camera, config), got.put)
        return got

    yield listen
    bus.undeclare_inputs()


def test_the_type_comes_from_the_key_and_the_number_from_next_to_the_message(
    session: zenoh.Session, received: Received
) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw"))
    session.put(IMAGE, b"\0\1\0\0", attachment=ATTACHMENT)
    assert got.get(timeout=DEADLINE_S) == InputSample(b"\0\1\0\0", "application/cdr;sensor_msgs/msg/Image", ATTACHMENT)


def test_lyricals_large_messages_come_in_and_those_for_others_do_not(
    session: zenoh.Session, received: Received
) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw"))
    session.put(f"{IMAGE}/_buf/00112233445566778899aabbccddeeff", b"for another", attachment=ATTACHMENT)
    session.put(f"{IMAGE}/_buf_cpu", b"for all", attachment=ATTACHMENT)
    assert got.get(timeout=DEADLINE_S).payload == b"for all"


def test_topics_below_are_other_topics(session: zenoh.Session, received: Received) -> None:
    raw, compressed = (
        received(configured("rmw_zenoh", topic)) for topic in ("/front/image_raw", "/front/image_raw/compressed")
    )
    session.put(COMPRESSED, b"jpeg", attachment=ATTACHMENT)
    session.put(IMAGE, b"raw", attachment=ATTACHMENT)
    assert raw.get(timeout=DEADLINE_S).payload == b"raw"
    assert compressed.get(timeout=DEADLINE_S).payload == b"jpeg"
    assert raw.empty()
    assert compressed.empty()


def test_another_domain_is_not_received(session: zenoh.Session, received: Received) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw", domain=7))
    session.put(IMAGE, b"domain 0", attachment=ATTACHMENT)
    session.put("7" + IMAGE[1:], b"domain 7", attachment=ATTACHMENT)
    assert got.get(timeout=DEADLINE_S).payload == b"domain 7"


def test_humble_has_no_hashes(session: zenoh.Session, received: Received) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw"))
    session.put("0/front/image_raw/sensor_msgs::msg::dds_::Image_/TypeHashNotSupported", b"x", attachment=ATTACHMENT)
    assert got.get(timeout=DEADLINE_S).encoding == "application/cdr;sensor_msgs/msg/Image"


@pytest.mark.parametrize("attachment", [None, b"", ATTACHMENT + b"\0", bytes(2**20)])
def test_an_attachment_that_is_none_is_empty(
    session: zenoh.Session, received: Received, attachment: bytes | None
) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw"))
    session.put(IMAGE, b"x", attachment=attachment)
    assert got.get(timeout=DEADLINE_S).attachment == b""


def test_a_key_without_a_type_still_comes_in_to_be_counted(session: zenoh.Session, received: Received) -> None:
    got = received(configured("rmw_zenoh", "/front/image_raw"))
    session.put("0/front/image_raw/what/ever", b"x")
    assert got.get(timeout=DEADLINE_S).encoding == "application/cdr;?"


@pytest.mark.parametrize(("namespace", "key"), [("", "front/image_raw"), ("/shuttle", "shuttle/front/image_raw")])
def test_a_bridge_puts_a_topic_on_its_name(
    session: zenoh.Session, received: Received, namespace: str, key: str
) -> None:
    got = received(configured("ros2dds", "/front/image_raw", namespace=namespace))
    session.put(key, b"\0\1\0\0")
    assert got.get(timeout=DEADLINE_S) == InputSample(
        b"\0\1\0\0", "zenoh/bytes", None, origin=str(session.zid()).encode()
    )


def test_keys_stay_keys_next_to_topics(session: zenoh.Session, received: Received) -> None:
    got = received(configured("rmw_zenoh", {"key": "front/camera"}))
    session.put("front/camera", b"x", encoding="application/msgpack", attachment=b"of the sender's own")
    assert got.get(timeout=DEADLINE_S) == InputSample(
        b"x", "application/msgpack", None, origin=str(session.zid()).encode()
    )


def test_keys_are_read_and_written_alike() -> None:
    for key in (IMAGE, COMPRESSED):
        assert TopicKey.parse(key).key == key
    assert TopicKey.parse(f"{IMAGE}/_buf_cpu").key == IMAGE


@pytest.mark.parametrize("key", ["0/a/b", "x/a/T/h", "0000/a/sensor_msgs::msg::dds_::Image_/h", "0/a/Image/h", ""])
def test_what_is_no_key_of_a_topic_is_reported(key: str) -> None:
    with pytest.raises(UsageError):
        TopicKey.parse(key)
