"""Video in bags: H.264 and H.265 by hand and by FFmpeg's encoders, in the messages of Foxglove, of
ffmpeg_image_transport and of `CompressedImage`; what cannot be decoded is left out and named."""

from __future__ import annotations

import base64
import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys.stores import ros2_humble as ros

import coec
from coec.calibration.types import CameraFrame, ImageFormat
from coec.config import LimitsConfig
from coec.errors import SourceError
from coec.io.images import decode_bgr
from coec.io.mcap.writer import write_messages
from coec.io.recordings.bag import BagRecording
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import damaged_of
from coec.io.ros import messages
from coec.io.ros.topics import FrameTopics, PairTopics
from coec.io.video import VideoReader, VideoTrack, codec_of
from support.recordings import STORE, Bag, drive_messages, ros_header
from support.ros import Packer
from support.simulated_drives import rendered_source
from support.video import FORMATS, START, Packet, encoded, parameters, pictures, slice_of

LIMITS = LimitsConfig()
IMAGES = pictures(12)
SECOND, INTERVAL = 10**9, 30_000_000
KEY = parameters() + slice_of(0, key=True)


def track_of(*packets: bytes, codec: str = "h264") -> tuple[list[bool], VideoTrack]:
    """Whether each packet holds a picture that can be decoded."""
    track = VideoTrack(codec)
    return [track.add(data, (number,)) for number, data in enumerate(packets)], track


# --- the structure of a stream, by hand -------------------------------------------------------------------------------


def test_what_comes_before_the_first_key_frame_is_left_out() -> None:
    decodable, track = track_of(slice_of(3), parameters(), slice_of(4), KEY, slice_of(1))
    assert decodable == [False, False, False, True, True]
    assert track.left_out == {"before the first key frame": 2}
    assert [packet.parameters is None for packet in track.packets] == [False, True]


@pytest.mark.parametrize(("size", "high", "order"), [(4, False, 2), (4, True, 0), (9, True, 1), (16, False, 0)])
def test_a_lost_packet_leaves_out_all_up_to_the_next_key_frame(size: int, high: bool, order: int) -> None:
    key = parameters(size, high=high, order=order) + slice_of(0, size, key=True)
    numbers = [slice_of(number, size) for number in (1, 2, 4, 5)]
    decodable, track = track_of(key, *numbers, key, numbers[0])
    assert decodable == [True, True, True, False, False, True, True]
    assert track.left_out == {"after a lost packet, up to the next key frame": 2}


def test_the_number_of_a_picture_starts_again_and_others_depend_on_nothing_of_it() -> None:
    count = [slice_of(number) for number in range(1, 40)]
    assert all(track_of(KEY, *count)[0])
    shown_between = [slice_of(1), slice_of(2, reference=False), slice_of(2, reference=False), slice_of(2), slice_of(3)]
    assert all(track_of(KEY, *shown_between)[0])
    decodable, _ = track_of(parameters(gaps=True) + slice_of(0, key=True), slice_of(1), slice_of(5))
    assert all(decodable), "an encoder that states gaps leaves numbers out on purpose"


def test_key_frames_of_h265_are_those_at_which_decoding_may_begin() -> None:
    def unit(kind: int) -> bytes:
        return START + bytes([kind << 1, 1, 0x80])

    sets = b"".join(unit(kind) for kind in (32, 33, 34))
    decodable, track = track_of(unit(1), sets, unit(35) + unit(20), unit(1), sets + unit(21), unit(8), codec="hevc")
    assert decodable == [False, False, True, True, True, True]
    # Those of the first key frame came in a packet of their own.
    assert [packet.parameters is not None for packet in track.packets] == [True, False, True, False]


@pytest.mark.parametrize(
    "damaged",
    [b"", b"\0\0\1", b"avcC\0\0\0\5hello", KEY[:9], (START + b"\x06\x01") * 65, START + b"\x67" + bytes(70_000)],
)
def test_a_damaged_packet_leaves_out_what_depends_on_it(damaged: bytes) -> None:
    decodable, track = track_of(KEY, damaged, slice_of(1), KEY, slice_of(1))
    assert decodable in ([True, False, False, True, True], [True, False, True, True, True])
    assert len(track.packets) + track.left_out.total() in (4, 5)


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("h264", "h264"),
        ("libx264;yuv420p;bgr8;bgr8", "h264"),
        ("H264_NVENC", "h264"),
        ("h265", "hevc"),
        ("hevc_vaapi", "hevc"),
        ("av1", None),
        ("vp9;h264", None),
        ("", None),
    ],
)
def test_the_codec_by_the_name_of_a_format_or_of_an_encoder(name: str, codec: str | None) -> None:
    assert codec_of(name) == codec


# --- pictures, by FFmpeg's encoders -----------------------------------------------------------------------------------


def reader_of(packets: list[Packet], encoder: str, limits: LimitsConfig = LIMITS) -> tuple[VideoReader, VideoTrack]:
    _, track = track_of(*(packet.data for packet in packets), codec=codec_of(FORMATS[encoder]) or "")
    return VideoReader(track, lambda at: packets[at[0]].data, limits), track


@pytest.mark.parametrize("between", [0, 3])
@pytest.mark.parametrize("encoder", FORMATS)
def test_each_packet_gives_its_own_picture_in_any_order(encoder: str, between: int) -> None:
    packets = encoded(encoder, IMAGES, between=between, crf="12")
    reader, track = reader_of(packets, encoder)
    assert len(track.packets) == len(IMAGES)
    shown = sorted(range(len(packets)), key=lambda number: packets[number].picture)
    for order in (shown, shown[::-1], [shown[7], shown[7], shown[2], shown[11]]):
        for number in order:
            image = reader.picture((number,))
            assert image is not None
            assert image.format is ImageFormat.BGR8
            pixels = np.frombuffer(image.data, np.uint8).reshape(48, 64, 3).astype(float)
            errors = [np.abs(pixels - other).mean() for other in IMAGES]
            assert int(np.argmin(errors)) == packets[number].picture


def test_a_picture_without_its_reference_is_not_made_up() -> None:
    packets = encoded("libx265", IMAGES)
    reader, track = reader_of([*packets[:2], *packets[3:]], "libx265")
    assert not track.left_out, "only the decoder sees it"
    shown = [reader.picture(packet.at) is not None for packet in track.packets]
    assert shown == [True, True, False, False, *[True] * 7]


def test_a_picture_above_the_limit_is_not_decoded() -> None:
    reader, track = reader_of(encoded("libx264", IMAGES), "libx264", LimitsConfig(max_image_pixels=4096))
    assert reader.picture(track.packets[0].at) is not None
    wide = pictures(2, 128, 64)
    reader, track = reader_of(encoded("libx264", wide), "libx264", LimitsConfig(max_image_pixels=4096))
    assert reader.picture(track.packets[0].at) is None


def test_damaged_streams_raise_nothing_else() -> None:
    packets = encoded("libx264", IMAGES, between=2)
    rng = np.random.default_rng(0)
    for _ in range(40):
        damaged = []
        for packet in packets:
            data = bytearray(packet.data)
            for place in rng.integers(0, len(data), 2).tolist():
                data[place] = int(rng.integers(0, 256))
            damaged.append(replace(packet, data=bytes(data)))
        reader, track = reader_of(damaged, "libx264")
        for decodable in track.packets:
            reader.picture(decodable.at)


def test_without_the_extra_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Bag(drive_of([(KEY, 0)])).write(tmp_path / "video.mcap")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(SourceError, match=r"pip install 'coec\[video\]'; or take the camera's topic of JPEG"):
        open_source(str(path))


# --- bags -------------------------------------------------------------------------------------------------------------


def drive_of(packets: list[tuple[bytes, int]], form: str = "h264") -> list[tuple[str, Any]]:
    """The drive with packets instead of its images, of the pictures of these numbers."""
    images = []
    for data, number in packets:
        header = ros_header(SECOND + number * INTERVAL, "optical")
        message = ros.sensor_msgs__msg__CompressedImage(header, form, np.frombuffer(data, np.uint8))
        images.append(("/front/image", message))
    return [*(entry for entry in drive_messages() if entry[0] != "/front/image"), *images]


def shown(source: str) -> list[tuple[int, bytes]]:
    """Number and pixels of each picture."""
    frames = [frame for frame in open_source(source).messages() if isinstance(frame, CameraFrame)]
    return [((frame.stamp_ns - SECOND) // INTERVAL, frame.image.data) for frame in frames]


def with_packets(path: Path, entries: list[tuple[str, str, bytes]], encoding: str) -> str:
    """The drive without its images, and messages of one more topic: schema, and data."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        of_ros = [
            (topic, message.__msgtype__, "cdr", bytes(STORE.serialize_cdr(message, message.__msgtype__)))
            for topic, message in drive_messages()
            if topic != "/front/image"
        ]
        for topic, schema, kind, data in [*of_ros, *((t, s, encoding, d) for t, s, d in entries)]:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, kind, writer.register_schema(schema, kind, b""))
            writer.add_message(channels[topic], 0, data, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return str(path)


@pytest.mark.parametrize("kind", ["ffmpeg", "foxglove", "protobuf", "json"])
def test_the_messages_of_foxglove_and_of_ffmpeg_image_transport(tmp_path: Path, kind: str) -> None:
    packets = encoded("libx264", IMAGES, between=2)
    expected = shown(str(Bag(drive_of([(p.data, p.picture) for p in packets])).write(tmp_path / "native.mcap")))
    assert [number for number, _ in expected] == list(range(len(IMAGES)))
    entries = []
    for packet in packets:
        sec, nsec = divmod(SECOND + packet.picture * INTERVAL, 10**9)
        stamp = {"sec": sec, "nsec": nsec}
        match kind:
            case "ffmpeg":
                packer = Packer().header("optical", sec, nsec).put("i", 64, 48).text("h264;yuv420p;bgr8;bgr8")
                data = packer.put("Q", packet.picture).put("B", 1, 0).octets(packet.data).done()
                schema, encoding = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "cdr"
            case "foxglove":
                data = Packer().header("optical", sec, nsec).octets(packet.data).text("h264").done()
                schema, encoding = "foxglove_msgs/msg/CompressedVideo", "cdr"
            case "protobuf":
                sdk = pytest.importorskip("foxglove.messages")
                message = sdk.CompressedVideo(
                    timestamp=sdk.Timestamp(**stamp), frame_id="optical", data=packet.data, format="h264"
                )
                data, schema, encoding = bytes(message.encode()), "foxglove.CompressedVideo", "protobuf"
            case _:
                document = {"timestamp": stamp, "frame_id": "optical", "format": "h264"}
                data = json.dumps({**document, "data": base64.b64encode(packet.data).decode()}).encode()
                schema, encoding = "foxglove.CompressedVideo", "json"
        entries.append(("/front/image", schema, data))
    assert shown(with_packets(tmp_path / f"{kind}.mcap", entries, encoding)) == expected


def test_pictures_that_cannot_be_decoded_are_counted_by_cause(tmp_path: Path) -> None:
    packets = [(p.data, p.picture) for p in encoded("libx264", IMAGES)]
    path = Bag(drive_of([*packets[2:6], *packets[7:]])).write(tmp_path / "video.mcap")
    recording = open_source(str(path))
    assert isinstance(recording, BagRecording)
    [recognition] = [each for each in recording.recognitions if each.code == "video_left_out"]
    assert "3 before the first key frame, 3 after a lost packet" in recognition.text
    assert [number for number, _ in shown(str(path))] == [5, 10, 11]
    # A damaged picture of H.265 is noticed only when it is decoded.
    packets = [(p.data, p.picture) for p in encoded("libx265", IMAGES)]
    path = Bag(drive_of([*packets[:2], *packets[3:]], "h265")).write(tmp_path / "h265.mcap")
    assert [number for number, _ in shown(str(path))] == [0, 1, *range(5, 12)]
    recording = open_source(str(path))
    list(recording.messages())
    assert "2 damaged (2 image_unreadable)" in damaged_of(recording).text


def test_a_video_without_a_key_frame_and_one_of_another_codec_are_refused_with_what_to_do(tmp_path: Path) -> None:
    path = Bag(drive_of([(slice_of(1), 0), (slice_of(2), 1)])).write(tmp_path / "no_key.mcap")
    with pytest.raises(SourceError, match=r"no picture of the video on /front/image can be decoded: 2 before the fi"):
        open_source(str(path))
    path = Bag(drive_of([(b"\x12\0", 0)], "av1")).write(tmp_path / "av1.mcap")
    with pytest.raises(SourceError, match=r"/front/image has video of the format 'av1': H.264 and H.265 are read"):
        open_source(str(path))
    path = Bag(drive_of([(KEY, 0)])).write(tmp_path / "no_data.mcap")
    with pytest.raises(SourceError, match="the picture of the video at 1000000000 ns cannot be decoded"):
        open_source(str(path))


def test_a_topic_of_pictures_comes_before_one_of_video(tmp_path: Path) -> None:
    packets = [(f"{topic}/video", message) for topic, message in drive_of([(KEY, 0)]) if topic == "/front/image"]
    both = Bag([*drive_messages(), *packets]).write(tmp_path / "both.mcap")
    alone = Bag(drive_messages()).write(tmp_path / "alone.mcap")
    assert shown(str(both)) == shown(str(alone))


SIM = "sim:seed=3&seconds=30&camera_hz=0.5&lidar_hz=0.5&camera=pinhole640x400@90&lidar=32"


@pytest.mark.slow
@pytest.mark.parametrize("encoder", FORMATS)
def test_a_drive_as_video_decides_within_one_sigma_of_the_same_drive_as_pictures(
    tmp_path: Path, encoder: str, record_property: Any
) -> None:
    drive = rendered_source(SIM)
    images, others = [], []
    topics = FrameTopics(drive.rig, drive.T_camera_lidar_start, PairTopics.default("front"))
    for frame in drive.messages():
        messages_of = list(topics.of(frame))
        others += [each for each in messages_of if each.type_name != messages.COMPRESSED_IMAGE]
        if isinstance(frame, CameraFrame):
            images.append((messages_of[-1], decode_bgr(frame.image, LIMITS)))
    for packet in encoded(encoder, [pixels for _, pixels in images]):
        message = images[packet.picture][0]
        header = ros_header(message.stamp_ns, drive.rig.camera_frame)
        video_message = ros.sensor_msgs__msg__CompressedImage(
            header, FORMATS[encoder], np.frombuffer(packet.data, np.uint8)
        )
        data = bytes(STORE.serialize_cdr(video_message, message.type_name))
        others.append(replace(message, data=data))
    write_messages(tmp_path / "video.mcap", sorted(others, key=lambda each: each.stamp_ns))
    write_messages(
        tmp_path / "pictures.mcap",
        sorted(
            [*(m for m in others if m.type_name != messages.COMPRESSED_IMAGE), *(m for m, _ in images)],
            key=lambda each: each.stamp_ns,
        ),
    )
    results = [
        coec.open(str(tmp_path / name)).calibrate(perturb=(1.0, -1.0, 0.5)) for name in ("pictures.mcap", "video.mcap")
    ]
    native, of_video = results
    assert native.accepted
    assert of_video.accepted
    distance = np.abs(of_video.correction[:3] - native.correction[:3]) / native.sigma[:3]
    record_property("figure", f"{encoder}: {distance.max():.2f} standard deviations")
    assert distance.max() < 1.0
