"""Damage in the middle of a recording: what it spoils is left out and reported, and the rest is read as before."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Rosbag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import CameraFrame, Frame, LidarFrame
from coec.config import CalibrationConfig
from coec.errors import CoecError, SourceError
from coec.io.mcap.windows import WindowWriter
from coec.io.recordings import window_cutting
from coec.io.recordings.bag import BagRecording
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import RecordingSource, damaged_of
from support.recordings import (
    STORE,
    TREE,
    Bag,
    camera_info_message,
    cloud_message,
    compressed_image_message,
    converted,
    odometry_message,
)
from support.windows import a_pair, a_rig

FRAMES = 40
PERIOD_NS = 100_000_000


def stamp_ns(number: int) -> int:
    return 10**9 + number * PERIOD_NS


def drive() -> list[tuple[str, Any]]:
    """Images, clouds and odometry at 10 Hz, each frame its own."""
    head = [
        ("/tf_static", ros.tf2_msgs__msg__TFMessage(TREE)),
        ("/front/camera_info", camera_info_message("plumb_bob", [0.0] * 5)),
    ]
    frames = [
        (topic, message)
        for number in range(FRAMES)
        for topic, message in (
            ("/odom", odometry_message(stamp_ns(number), 1.0)),
            ("/points", cloud_message(stamp_ns(number), 1.0 + number)),
            ("/front/image", compressed_image_message(stamp_ns(number))),
        )
    ]
    return [*head, *frames]


DRIVE = drive()


def ros_1_bag(path: Path) -> Path:
    writer = Rosbag1(path)
    writer.chunk_threshold = 2000
    with writer:
        connections: dict[str, Any] = {}
        for time, (topic, message) in enumerate(DRIVE):
            name = message.__msgtype__
            if topic not in connections:
                definition, md5 = STORE.generate_msgdef(name, ros_version=1)
                connections[topic] = writer.add_connection(topic, name, msgdef=definition, md5sum=md5)
            data = bytes(STORE.cdr_to_ros1(STORE.serialize_cdr(message, name), name))
            writer.write(connections[topic], time, data)
    return path


def db3(path: Path) -> Path:
    mcap = Bag(DRIVE).write(path.with_name("source.mcap"))
    (file,) = converted(mcap, path.with_name("folder"), StoragePlugin.SQLITE3).glob("*.db3")
    return file


def window(path: Path) -> Path:
    writer = WindowWriter(path, a_rig(), np.eye(4), "front-1", CalibrationConfig(), {})
    for number in range(FRAMES):
        writer.add(a_pair(number, points=40))
    return writer.finish().path


def folder(path: Path) -> Path:
    path.mkdir()
    frames = []
    for number in range(FRAMES):
        cv2.imwrite(str(path / f"{number}.png"), np.full((48, 64), number, np.uint8))
        np.save(path / f"{number}.npy", np.full((50, 3), 1.0 + number, np.float32))
        frames.append(f"  - {{image: {number}.png, cloud: {number}.npy, stamp_ns: {stamp_ns(number)}}}")
    head = (
        "pair: front\ncamera: {model: pinhole, width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}\n"
        "T_camera_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\nframes:\n"
    )
    (path / "dataset.yaml").write_text(head + "\n".join(frames))
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda path: Bag(DRIVE).write(path),
    "bag": ros_1_bag,
    "db3": db3,
    "window.mcap": window,
}


def read(source: Path) -> tuple[RecordingSource, list[Frame]]:
    recording = open_source(str(source))
    return recording, list(recording.messages())


def content(frame: Frame) -> bytes:
    if isinstance(frame, CameraFrame):
        return frame.image.data
    return frame.xyz_m.tobytes() if isinstance(frame, LidarFrame) else repr(frame).encode()


def with_message(number: int, change: Callable[[Any], Any], topic: str) -> list[tuple[str, Any]]:
    places = [place for place, (of, _) in enumerate(DRIVE) if of == topic]
    changed = list(DRIVE)
    changed[places[number]] = topic, change(changed[places[number]][1])
    return changed


CHANGES: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "an image that is cut off": ("/front/image", lambda m: replace(m, data=m.data[:-30]), "image_truncated"),
    "an image of nothing": ("/front/image", lambda m: replace(m, data=m.data[:0]), "image_unknown_format|truncated"),
    "a cloud that claims more points": ("/points", lambda m: replace(m, width=10**6), "cloud_"),
    "a cloud without a finite point": (
        "/points",
        lambda m: replace(m, data=np.frombuffer(np.full((4, 3), np.nan, "<f4").tobytes(), np.uint8)),
        "cloud_",
    ),
}


@pytest.mark.fault(
    "one damaged image or cloud in a bag", "it is left out and reported with its cause; all else is read"
)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_one_damaged_frame_of_a_bag_is_left_out(tmp_path: Path, change: tuple[str, Callable[[Any], Any], str]) -> None:
    topic, spoil, cause = change
    _, whole = read(Bag(DRIVE).write(tmp_path / "whole.mcap"))
    for number in (0, FRAMES // 2, FRAMES - 1):
        recording, frames = read(Bag(with_message(number, spoil, topic)).write(tmp_path / "drive.mcap"))
        kind = CameraFrame if topic == "/front/image" else LidarFrame
        lost = next(f for f in whole if isinstance(f, kind) and f.stamp_ns == stamp_ns(number))
        assert [content(f) for f in frames] == [content(f) for f in whole if f is not lost]
        assert re.search(rf"^1 damaged \(1 \w*({cause})\w*\); the first: .*drive.mcap", damaged_of(recording).text)


@pytest.mark.fault("a stamp or a frame's name that is damaged", "its message is left out and reported")
@pytest.mark.parametrize("topic", ["/front/image", "/points"])
def test_damaged_headers(tmp_path: Path, topic: str) -> None:
    def stamped(message: Any) -> Any:
        return replace(message, header=replace(message.header, stamp=replace(message.header.stamp, sec=2**30)))

    def named(message: Any) -> Any:
        return replace(message, header=replace(message.header, frame_id="opt\x0ecal"))

    for spoil, reported in ((stamped, "far from the time of its receipt"), (named, "as no other does")):
        recording, frames = read(Bag(with_message(7, spoil, topic)).write(tmp_path / "drive.mcap"))
        assert len(frames) == 3 * FRAMES - 1
        assert reported in damaged_of(recording).text


@pytest.mark.fault("one CameraInfo among many with a flipped bit", "it is left out, and the lens is that of the others")
def test_a_damaged_camera_info_is_left_out(tmp_path: Path) -> None:
    info = camera_info_message("plumb_bob", [0.0] * 5)
    odd = replace(info, k=np.where(np.arange(9) == 0, 3.0 * info.k, info.k))
    infos = [("/front/camera_info", odd if number == 4 else info) for number in range(12)]
    recording = open_source(str(Bag([*infos, *DRIVE]).write(tmp_path / "drive.mcap")))
    assert recording.rig.camera.fx == info.k[0]
    assert isinstance(recording, BagRecording)
    assert "camera_info_damaged" in [one.code for one in recording.recognitions]
    few = Bag([*infos[2:6], *DRIVE]).write(tmp_path / "few.mcap")
    with pytest.raises(SourceError, match="the CameraInfo changes on the way"):
        open_source(str(few))


@pytest.mark.fault("a truncated PNG and an empty cloud in a folder of images", "both are left out and reported")
def test_damaged_files_of_a_folder_are_left_out(tmp_path: Path) -> None:
    source = folder(tmp_path / "drive")
    (source / "3.png").write_bytes((source / "3.png").read_bytes()[:-20])
    (source / "5.npy").write_bytes(b"")
    recording, frames = read(source)
    assert len(frames) == 2 * FRAMES - 2
    assert "2 damaged (1 cloud_unreadable, 1 image_truncated); the first: " in damaged_of(recording).text
    loaded = window_cutting.load_window(str(source), None, 25, lambda *_: None)
    assert len(loaded.window.pairs) == 25
    assert not {3, 5} & {(pair.stamp_ns - 10**9) // PERIOD_NS for pair in loaded.window.pairs}


@pytest.mark.fault("an image of another size than all others", "its pair is replaced by another one, and reported")
def test_an_image_of_another_size_is_replaced(tmp_path: Path) -> None:
    source = folder(tmp_path / "drive")
    cv2.imwrite(str(source / "0.png"), np.zeros((48, 32), np.uint8))
    loaded = window_cutting.load_window(str(source), 25, 25, lambda *_: None)
    assert (len(loaded.window.pairs), loaded.window.pairs[0].stamp_ns) == (25, stamp_ns(1))
    assert "1 image_size_mismatch" in loaded.recognitions[-1].text


@pytest.mark.fault("an image whose pixels cannot be decoded", "its pair is replaced by another one, and reported")
def test_a_picture_that_only_the_decoder_refuses_is_replaced(tmp_path: Path) -> None:
    source = folder(tmp_path / "drive")
    data = bytearray((source / "0.png").read_bytes())
    data[data.index(b"IDAT") + 12] ^= 0xFF
    (source / "0.png").write_bytes(data)
    loaded = window_cutting.load_window(str(source), 25, 25, lambda *_: None)
    assert len(loaded.window.pairs) == 25
    assert loaded.window.pairs[0].stamp_ns == stamp_ns(1)
    (reported,) = (one.text for one in loaded.recognitions if one.code == "damaged_frames")
    assert "1 image_corrupt" in reported


@pytest.mark.fault("a recording of which most frames are damaged", "the refusal names the damage")
def test_too_few_sound_frames_are_refused_for_their_damage(tmp_path: Path) -> None:
    source = folder(tmp_path / "drive")
    for number in range(FRAMES - 4):
        (source / f"{number}.png").write_bytes(b"\x89PNG")
    with pytest.raises(SourceError, match=r"only 4 of 25 pairs can be read: 36 damaged \(36 image_truncated\)"):
        window_cutting.load_window(str(source), None, 25, lambda *_: None)
    for number in range(FRAMES):
        (source / f"{number}.png").write_bytes(b"\x89PNG")
    with pytest.raises(SourceError, match=r"none of 25 images can be read; the first: .*0.png: the image ends after"):
        window_cutting.load_window(str(source), None, 25, lambda *_: None)


def middle_of(path: Path) -> tuple[bytes, int]:
    """A file, and where data of a frame in its middle stands."""
    whole = path.read_bytes()
    return whole, whole.index(b"\xff\xd8\xff", len(whole) // 2)


@pytest.mark.fault("a flipped bit in a chunk of an MCAP", "the chunk is left out and reported; all else is read")
@pytest.mark.parametrize("kind", ["mcap", "window.mcap"])
def test_a_chunk_with_a_wrong_crc_is_left_out(tmp_path: Path, kind: str) -> None:
    path = WRITERS[kind](tmp_path / f"drive.{kind}")
    _, sound = read(path)
    whole, at = middle_of(path)
    path.write_bytes(whole[: at + 40] + bytes([whole[at + 40] ^ 4]) + whole[at + 41 :])
    recording, frames = read(path)
    assert re.search(r"byte \d+: size or CRC of a chunk does not agree", damaged_of(recording).text)
    known = {content(frame) for frame in sound}
    assert {content(frame) for frame in frames} <= known
    assert 0.8 * len(sound) < len(frames) < len(sound)


@pytest.mark.fault("a wrong length of a record in a bag", "reading goes on with the next chunk of the index")
@pytest.mark.parametrize("kind", ["mcap", "bag"])
@pytest.mark.parametrize("number", [3, 5, -1])
def test_a_record_with_a_wrong_length_is_left_out(tmp_path: Path, kind: str, number: int) -> None:
    path = WRITERS[kind](tmp_path / f"drive.{kind}")
    _, sound = read(path)
    whole = bytearray(path.read_bytes())
    if kind == "mcap":
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        at = summary.chunk_indexes[number].chunk_start_offset + 1
    else:
        with Reader1(path) as reader:
            at = reader.chunk_infos[number].pos
    whole[at : at + 4] = b"\xf0\xff\xff\x7f"
    path.write_bytes(whole)
    recording, frames = read(path)
    assert "1 record_unreadable" in damaged_of(recording).text
    assert {content(frame) for frame in frames} <= {content(frame) for frame in sound}
    assert len(frames) > 0.6 * len(sound)


@pytest.mark.fault(
    "random bytes flipped in random messages of a recording",
    "the sound frames are read, or an error of ours: nothing else is raised",
)
@pytest.mark.parametrize("kind", WRITERS)
def test_random_damage_raises_nothing_else(
    tmp_path: Path, kind: str, record_property: Callable[[str, object], None]
) -> None:
    path = WRITERS[kind](tmp_path / f"drive.{kind}")
    _, sound = read(path)
    whole, known = path.read_bytes(), {content(frame) for frame in sound}
    rng = np.random.default_rng(3)
    refused = reported = 0
    retained = []
    for _ in range(40):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole) // 50, 19 * len(whole) // 20, 2).tolist():
            damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            recording, frames = read(path)
        except CoecError:
            refused += 1
            continue
        reported += bool(damaged_of(recording))
        retained.append(sum(content(frame) in known for frame in frames) / len(sound))
    record_property("figure", f"{kind}: of 40 files {refused} refused, {reported} with damage that was reported")
    assert refused < 12
    assert np.median(retained) > 0.9
