"""`coec play` on topics of ROS 2: a bag's own bytes under the keys of rmw_zenoh or of a bridge."""

from __future__ import annotations

import os
import signal
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash
import zenoh
from mcap.writer import Writer

from cli.conftest import SMALL, Coec
from coec.config import LimitsConfig, ZenohConfig
from coec.io.ros.message_decoding import decode
from coec.io.ros.messages import VELODYNE_SCAN
from coec.io.ros.wire_format import MessageAttachment
from coec.io.zenoh.bus import open_session
from support.fake_worker import wait_until
from support.packets import OUSTER, ouster_message, write_entries
from support.recordings import STORE, Bag, drive_messages
from support.ros import velodyne_scan
from support.router import free_port

SECONDS = 20.0
TF_KEY = (
    "0/tf_static/tf2_msgs::msg::dds_::TFMessage_/"
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
)
IMAGE_KEY = (
    "0/front/image/sensor_msgs::msg::dds_::CompressedImage_/"
    "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a"
)


class Listener:
    """A router, and what comes through it."""

    def __init__(self, endpoint: str, session: zenoh.Session) -> None:
        self.endpoint = endpoint
        self.session = session
        self.samples: defaultdict[str, list[zenoh.Sample]] = defaultdict(list)
        self.tokens: set[str] = set()
        self._open = [
            session.declare_subscriber("**", zenoh.handlers.Callback(self._receive, indirect=False)),
            session.liveliness().declare_subscriber("@ros2_lv/**", zenoh.handlers.Callback(self._note, indirect=False)),
        ]

    def _receive(self, sample: zenoh.Sample) -> None:
        self.take(sample)

    def take(self, sample: zenoh.Sample) -> None:
        self.samples[str(sample.key_expr)].append(sample)

    def _note(self, sample: zenoh.Sample) -> None:
        self.tokens.add(str(sample.key_expr))

    def attachments(self, key: str) -> list[MessageAttachment]:
        reported = [MessageAttachment.parse(s.attachment.to_bytes()) for s in self.samples[key] if s.attachment]
        return [attachment for attachment in reported if attachment is not None]

    def count(self) -> int:
        return sum(map(len, self.samples.values()))

    def payloads(self, key: str) -> list[bytes]:
        return [sample.payload.to_bytes() for sample in self.samples[key]]


@pytest.fixture
def listener() -> Iterator[Listener]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        yield Listener(endpoint, session)


def recorded(drive: list[tuple[str, Any]], topic: str) -> list[bytes]:
    return [bytes(STORE.serialize_cdr(m, m.__msgtype__)) for name, m in drive if name == topic]


def played(coec: Coec, listener: Listener, source: object, *options: object) -> Any:
    reported = coec("play", source, *options, "--rate", 0, "--connect", listener.endpoint, "--json")
    assert reported.status == 0, reported.err
    wait_until(lambda: listener.count() == sum(reported.document["frames"].values()), "every message", SECONDS)
    return reported.document


def test_a_bag_keeps_its_topics_types_and_bytes_on_the_keys_of_rmw_zenoh(
    coec: Coec, listener: Listener, tmp_path: Path
) -> None:
    drive = drive_messages()
    document = played(coec, listener, Bag(drive).write(tmp_path / "b.mcap"), "--middleware", "rmw_zenoh")
    assert document["frames"] == {
        "/front/image": 4, "/front/camera_info": 1, "/points": 8, "/odom": 20, "/tf_static": 1
    }  # fmt: skip
    assert document["nobody_listened_to"] == []
    assert listener.payloads(TF_KEY) == recorded(drive, "/tf_static")
    assert listener.payloads(IMAGE_KEY) == recorded(drive, "/front/image")
    (token,) = (token for token in listener.tokens if "%front%image/" in token)
    assert token.split("/")[5:10] == ["MP", "%", "%", "coec_play", "%front%image"]
    reported = listener.attachments(IMAGE_KEY)
    assert [attachment.sequence for attachment in reported] == [1, 2, 3, 4]
    assert {attachment.gid for attachment in reported} == {
        xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
    }
    wait_until(lambda: not list(listener.session.liveliness().get("@ros2_lv/**")), "tokens are withdrawn", SECONDS)


def test_a_bag_on_the_keys_of_a_bridge(coec: Coec, listener: Listener, tmp_path: Path) -> None:
    drive = drive_messages()
    config = tmp_path / "coec.yaml"
    config.write_text(
        "middleware: ros2dds\nros: {namespace: /shuttle}\npairs:\n- name: front\n  points: /points\n"
        "  camera:\n    topic: /front/image\n"
        "    intrinsics: {model: pinhole, width: 64, height: 48, fx: 5, fy: 5, cx: 3, cy: 2}\n"
        "  T_camera_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    document = played(coec, listener, Bag(drive).write(tmp_path / "b.mcap"), "--config", config)
    assert document["nobody_listened_to"] == []
    assert set(listener.samples) == {f"shuttle{topic}" for topic in document["frames"]}
    assert listener.payloads("shuttle/points") == recorded(drive, "/points")
    assert all(sample.attachment is None for sample in listener.samples["shuttle/points"])


def test_topics_are_selected_by_name(coec: Coec, listener: Listener, tmp_path: Path) -> None:
    bag = Bag(drive_messages()).write(tmp_path / "b.mcap")
    document = played(coec, listener, bag, "--middleware", "ros2dds", "--topics", "/points,/odom")
    assert set(document["frames"]) == {"/points", "/odom"}
    message = coec("play", bag, "--middleware", "ros2dds", "--topics", "/lidar", "--connect", listener.endpoint)
    assert message.status == 2
    assert "no topic /lidar; there: /front/camera_info (sensor_msgs/msg/CameraInfo, 1 message)" in message.err


def test_stamps_begin_now_where_requested_and_all_else_is_as_recorded(
    coec: Coec, listener: Listener, tmp_path: Path
) -> None:
    drive = drive_messages()
    bag = Bag(drive).write(tmp_path / "b.mcap")
    played(coec, listener, bag, "--middleware", "rmw_zenoh", "--start-now")
    now, then = listener.payloads(IMAGE_KEY), recorded(drive, "/front/image")
    assert [payload[12:] for payload in now] == [payload[12:] for payload in then]
    stamps = [decode("sensor_msgs/msg/CompressedImage", payload, LimitsConfig()).stamp_ns for payload in now]
    np.testing.assert_array_equal(np.diff(stamps), 100_000_000)
    # The recorder's clock began at 0, the sensors' at 1 s.
    began_ns = stamps[0] - 10**9
    assert 0 < listener.attachments(IMAGE_KEY)[0].source_ns - began_ns < SECONDS * 10**9


def test_a_loop_goes_on_in_time_until_it_is_stopped(
    coec: Coec, listener: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = drive_messages()
    take = listener.take

    def counted(sample: zenoh.Sample) -> None:
        take(sample)
        if listener.count() == 2 * len(drive) + 1:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(listener, "take", counted)
    bag = Bag(drive).write(tmp_path / "b.mcap")
    reported = coec("play", bag, "--middleware", "ros2dds", "--loop", "--rate", 0, "--connect", listener.endpoint)
    assert reported.status == 0, reported.err
    payloads = listener.payloads("front/image")
    assert payloads[:4] == recorded(drive, "/front/image")
    stamps = [decode("sensor_msgs/msg/CompressedImage", payload, LimitsConfig()).stamp_ns for payload in payloads]
    assert len(stamps) > 4
    # Times between recorder's stamps: the pass, and the pause before the next.
    assert stamps[4] - stamps[0] == len(drive) - 1 + 100_000_000


def test_types_that_are_not_ros_own_have_no_key_of_rmw_zenoh(coec: Coec, listener: Listener, tmp_path: Path) -> None:
    bag = tmp_path / "b.mcap"
    with bag.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for topic, type_name in (("/wheels", "acme_msgs/msg/Wheels"), ("/word", "std_msgs/msg/String")):
            schema = writer.register_schema(type_name, "ros2msg", b"int32 data")
            writer.add_message(writer.register_channel(topic, "cdr", schema), 5, b"\0\1\0\0anything", 5)
        writer.finish()  # type: ignore[no-untyped-call]
    reported = coec("play", bag, "--middleware", "rmw_zenoh", "--rate", 0, "--connect", listener.endpoint, "--json")
    assert reported.document["frames"] == {"/word": 1}
    assert "hash is not known: '/wheels' ('acme_msgs/msg/Wheels')" in reported.err
    reported = coec("play", bag, "--middleware", "rmw_zenoh", "--topics", "/wheels", "--connect", listener.endpoint)
    assert reported.status == 2
    listener.samples.clear()
    document = played(coec, listener, bag, "--middleware", "ros2dds", "--start-now")
    assert document["frames"] == {"/wheels": 1, "/word": 1}
    assert listener.payloads("wheels") == [b"\0\1\0\0anything"]


@pytest.mark.parametrize("middleware", ["rmw_zenoh", "ros2dds"])
def test_packets_of_lidars_are_played_byte_for_byte(
    coec: Coec, listener: Listener, tmp_path: Path, middleware: str
) -> None:
    packets = {"/velodyne_packets": (VELODYNE_SCAN, velodyne_scan(3)), "/os/packets": (OUSTER, ouster_message(b"abc"))}
    entries = [(number, topic, *sent) for number, (topic, sent) in enumerate(packets.items())]
    bag = write_entries(tmp_path / "b.mcap", entries)
    document = played(coec, listener, bag, "--middleware", middleware)
    assert document["frames"] == dict.fromkeys(packets, 1)
    keys = {topic: key for topic in packets for key in listener.samples if topic.strip("/") in key.replace("%", "/")}
    assert {topic: listener.payloads(key) for topic, key in keys.items()} == {t: [d] for t, (_, d) in packets.items()}
    listener.samples.clear()
    reported = coec("play", bag, "--middleware", middleware, "--rate", 0, "--connect", listener.endpoint, "--start-now")
    assert "stamps stay as recorded, because they are within packets: /os/packets, /velodyne_packets" in reported.err


@pytest.mark.fault("a bag with topics that are not valid ROS names", "they are named, escaped, and not played")
@pytest.mark.parametrize("topic", ["/**", "/a/*/b", "a", "/", "//a", "/a$b", "/a\x1b[2J", "/" + 300 * "a", "/@ros2_lv"])
def test_names_that_are_none_are_left_out(coec: Coec, listener: Listener, tmp_path: Path, topic: str) -> None:
    bag = Bag([*drive_messages(), (topic, drive_messages()[1][1])]).write(tmp_path / "b.mcap")
    reported = coec("play", bag, "--middleware", "ros2dds", "--rate", 0, "--connect", listener.endpoint, "--json")
    assert reported.status == 0, reported.err
    assert len(reported.document["frames"]) == 5
    assert ascii(topic) in reported.err.replace("\n", "")


def test_other_recordings_are_played_below_the_name_of_their_pair(coec: Coec, listener: Listener) -> None:
    document = played(coec, listener, SMALL, "--middleware", "ros2dds", "--pair", "nose")
    assert set(document["frames"]) == {
        "/tf_static", "/nose/camera/image/compressed", "/nose/camera/camera_info", "/nose/lidar/points",
        "/nose/odometry",
    }  # fmt: skip
    assert document["frames"]["/nose/camera/image/compressed"] == 6
    joint: Any = STORE.deserialize_cdr(listener.payloads("tf_static")[0], "tf2_msgs/msg/TFMessage")
    assert joint.transforms[0].child_frame_id == "lidar"


RIG = "sim:rig=four-fisheyes&seconds=0.5&camera=fisheye32&camera_hz=2&lidar_hz=2&ego_hz=4"
SENSORS = ("front", "left", "rear", "right", "roof", "near_left", "near_right")


def test_all_sensors_of_a_rig_are_played_on_a_key_each(coec: Coec, listener: Listener) -> None:
    pytest.importorskip("embreex", reason="needs embreex")
    outcome = coec("play", RIG, "--connect", listener.endpoint, "--rate", 0, "--json")
    assert outcome.status == 0
    assert outcome.document["frames"] == dict.fromkeys(SENSORS, 1) | {"ego": 2}
    wait_until(lambda: listener.count() == 9, "all frames", SECONDS)
    assert set(listener.samples) == {f"sensors/{sensor}" for sensor in (*SENSORS, "ego")}


def test_all_sensors_of_a_rig_are_played_on_topics_of_their_own(coec: Coec, listener: Listener) -> None:
    pytest.importorskip("embreex", reason="needs embreex")
    outcome = coec("play", RIG, "--connect", listener.endpoint, "--rate", 0, "--middleware", "ros2dds", "--json")
    assert outcome.status == 0
    cameras, lidars = SENSORS[:4], SENSORS[4:]
    topics = {f"{camera}/image/compressed" for camera in cameras} | {f"{camera}/camera_info" for camera in cameras}
    topics |= {f"{lidar}/points" for lidar in lidars} | {"odometry", "tf_static"}
    wait_until(lambda: set(listener.samples) == topics, "all topics", SECONDS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--topics", "/points"), "add --middleware"),
        (("--middleware", "ros2dds", "--encoding", "cdr"), "topics of ROS 2 carry CDR"),
    ],
)
def test_options_that_do_not_go_together_are_refused(coec: Coec, tmp_path: Path, options: Any, message: str) -> None:
    reported = coec("play", Bag(drive_messages()).write(tmp_path / "b.mcap"), *options)
    assert reported.status == 2
    assert message in reported.err


def test_a_drive_of_several_lidars_is_replayed_with_the_topics_of_the_configured_pair(
    coec: Coec, tmp_path: Path
) -> None:
    others = [("/rear/points", message) for topic, message in drive_messages() if topic == "/points"]
    bag = Bag([*drive_messages(), *others]).write(tmp_path / "two.mcap")
    reported = coec("replay", bag)
    assert (reported.status, "choose one with ?points=...: /points" in reported.err) == (1, True)
    configuration = tmp_path / "coec.yaml"
    configuration.write_text(
        "middleware: rmw_zenoh\npairs:\n  - name: front\n"
        "    camera: {topic: /front/image, type: sensor_msgs/msg/CompressedImage, frame_id: optical,\n"
        "      intrinsics: {model: pinhole, width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}}\n"
        "    lidar: {topic: /points, frame_id: lidar}\n"
        "    T_camera_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    reported = coec("replay", bag, "--config", configuration, "--from", 1000)
    assert "no camera frame lies between --from and --until: two.mcap/front/image is shorter" in reported.err
    reported = coec("replay", bag, "--from", 5, "--until", 1)
    assert (reported.status, "--until 1 is not later than --from 5" in reported.err) == (2, True)
    reported = coec("replay", bag, "--config", configuration, "--against", configuration)
    assert "coec.yaml is no log of decisions" in reported.err
