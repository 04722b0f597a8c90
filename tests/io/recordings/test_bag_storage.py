"""Every storage of rosbag2, written by `rosbags`, holds the same recording; and files that nobody vouches for."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from ruamel.yaml import YAML

from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame
from coec.errors import SourceError, WindowError
from coec.io.recordings.layouts import open_source
from support.recordings import STORE, Bag, compressed_image_message, drive_messages

SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
NONE, FILE, MESSAGE = CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE


def a_folder(
    path: Path,
    plugin: StoragePlugin,
    mode: CompressionMode = CompressionMode.NONE,
    drive: list[tuple[str, Any]] | None = None,
) -> Path:
    """A drive as a folder of rosbag2."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    if mode is not NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for time, (topic, message) in enumerate(drive_messages() if drive is None else drive):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=STORE)
            writer.write(connections[topic], time, STORE.serialize_cdr(message, name))
    return path


def reported(message: Frame) -> tuple[object, ...]:
    match message:
        case CameraFrame():
            return message.stamp_ns, message.image.data
        case LidarFrame():
            return message.stamp_ns, message.xyz_m.tobytes()
        case EgoMotion():
            return message.stamp_ns, message.linear_mps


@pytest.mark.parametrize("plugin", [SQLITE, MCAP])
@pytest.mark.parametrize("mode", [NONE, FILE, MESSAGE])
def test_every_folder_holds_the_same_recording(tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode) -> None:
    expected = open_source(str(Bag(drive_messages()).write(tmp_path / "drive.mcap")))
    result = open_source(str(a_folder(tmp_path / "drive", plugin, mode)))
    assert [reported(m) for m in result.messages()] == [reported(m) for m in expected.messages()]
    assert result.rig.camera == expected.rig.camera
    assert result.rig.pair == "drive"
    np.testing.assert_array_equal(result.rig.T_camera_lidar_nominal, expected.rig.T_camera_lidar_nominal)


def test_a_file_of_a_folder_may_be_opened_alone(tmp_path: Path) -> None:
    folder = a_folder(tmp_path / "drive", SQLITE)
    (file,) = folder.glob("*.db3")
    assert len(list(open_source(str(file)).messages())) == 4 + 8 + 20


def test_a_bag_in_several_files_is_one(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    drive = drive_messages()
    for number in range(3):
        Bag(drive[number::3]).write(folder / f"split_{number}.mcap")
    information = {"storage_identifier": "mcap", "relative_file_paths": [f"split_{n}.mcap" for n in range(3)]}
    with (folder / "metadata.yaml").open("w") as stream:
        YAML().dump({"rosbag2_bagfile_information": information}, stream)
    expected = open_source(str(Bag(drive).write(tmp_path / "drive.mcap")))
    assert [reported(m) for m in open_source(str(folder)).messages()] == [reported(m) for m in expected.messages()]
    (folder / "split_1.mcap").unlink()
    with pytest.raises(SourceError, match=r"split lacks split_1\.mcap"):
        open_source(str(folder))


@pytest.mark.parametrize(
    ("metadata", "stated"),
    [
        ("", "is empty"),
        ("[1]", "is no metadata of rosbag2"),
        ("{", "is not valid YAML"),
        ("rosbag2_bagfile_information: {storage_identifier: mcap}", "relative_file_paths"),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [../../etc/passwd]}",
            "lacks passwd",
        ),
        (
            "rosbag2_bagfile_information: {storage_identifier: bag, relative_file_paths: [a]}",
            "is neither mcap nor sqlite3",
        ),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [a], compression_format: lz4,"
            " compression_mode: FILE}",
            "is not zstd",
        ),
    ],
)
def test_metadata_that_cannot_be_used_is_reported(tmp_path: Path, metadata: str, stated: str) -> None:
    (tmp_path / "metadata.yaml").write_text(metadata)
    with pytest.raises(SourceError, match=stated):
        open_source(str(tmp_path))


@pytest.mark.parametrize("suffix", ["db3", "mcap.zstd", "db3.zstd"])
@pytest.mark.fault("a bag that is cut off or has flipped bits", "an error that names the file; nothing else is raised")
def test_damaged_files_are_refused(tmp_path: Path, suffix: str) -> None:
    plugin, mode = SQLITE if "db3" in suffix else MCAP, FILE if suffix.endswith("zstd") else NONE
    folder = a_folder(tmp_path / "drive", plugin, mode)
    (file,) = folder.glob(f"*.{suffix}")
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(40):
        size = int(rng.integers(0, len(whole)))
        damaged = bytearray(whole[:size] if rng.random() < 0.5 else whole)
        for place in rng.integers(0, max(len(damaged), 1), 8).tolist():
            if damaged:
                damaged[place] ^= int(rng.integers(1, 256))
        file.write_bytes(damaged)
        try:
            list(open_source(str(folder)).messages())
        except SourceError:
            refused += 1
    assert refused > 20  # a flipped bit in a picture is a flipped bit in a picture


def test_a_view_that_calls_itself_a_table_is_none(tmp_path: Path) -> None:
    file = tmp_path / "evil.db3"
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        connection.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, zeroblob(1000000) AS data FROM n"
        )
        connection.commit()
    with pytest.raises(SourceError, match="has no tables messages and topics"):
        open_source(str(file))


def test_rows_that_are_no_messages_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "odd.db3"
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        connection.execute("CREATE TABLE messages(id, topic_id, timestamp, data)")
        connection.execute("INSERT INTO topics VALUES(1, '/a', 'sensor_msgs/msg/Image', 'cdr')")
        connection.execute("INSERT INTO messages VALUES(1, 1, 0, 'text')")
        connection.commit()
    with pytest.raises(SourceError, match="message 1 holds no bytes"):
        open_source(str(file))


@pytest.mark.fault("a bag that is cut off after any kilobyte", "an error that names the file; nothing else is raised")
@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_a_bag_that_is_cut_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    if suffix == "mcap":
        file = Bag(drive_messages(), chunking=False).write(tmp_path / "drive.mcap")
    else:
        (file,) = a_folder(tmp_path / "drive", SQLITE).glob("*.db3")
    whole = file.read_bytes()
    cuts = list(range(0, len(whole), 1024))
    assert len(cuts) > 15
    for size in cuts:
        file.write_bytes(whole[:size])
        with pytest.raises((SourceError, WindowError), match=file.name):
            list(open_source(str(file)).messages())


def a_database(path: Path, messages: str, row: str, topic: str = "'/a'") -> Path:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        connection.execute(f"INSERT INTO topics VALUES(1, {topic}, 'acme_msgs/msg/Any', 'cdr')")
        connection.execute(f"CREATE TABLE messages{messages}")
        connection.execute(f"INSERT INTO messages VALUES{row}")
        connection.commit()
    return path


COLUMNS = "(id, topic_id, timestamp, data)"


@pytest.mark.fault("a database whose schema makes messages up", "refused before it gives more than the file holds")
@pytest.mark.parametrize(
    ("messages", "row", "topic", "stated"),
    [
        ("(id, topic_id, timestamp, data BLOB AS (zeroblob(9000000)))", "(1, 1, 0)", "'/a'", "longer than the file"),
        ("(id PRIMARY KEY, topic_id, timestamp, data) WITHOUT ROWID", "(1, 1, 0, x'00')", "'/a'", "is damaged"),
        ("(rowid TEXT, topic_id, timestamp, data)", "('one', 1, 0, x'00')", "'/a'", "no number"),
        (COLUMNS, "(1, 7, 0, x'00')", "'/a'", "no topic"),
        (COLUMNS, "(1, 1, 'noon', x'00')", "'/a'", "no time"),
        (COLUMNS, "(1, 1, 0, x'00')", "zeroblob(9)", "a topic has no name"),
        (COLUMNS, "(1, 1, 0, x'00')", "hex(zeroblob(5000))", "a topic has no name"),
    ],
    ids=range(7),
)
def test_a_schema_that_makes_messages_up_is_refused(
    tmp_path: Path, messages: str, row: str, topic: str, stated: str
) -> None:
    with pytest.raises(SourceError, match=stated):
        open_source(str(a_database(tmp_path / "evil.db3", messages, row, topic)))


@pytest.mark.fault("a bag that unpacks to a thousand times its size", "refused, and nothing of it is left behind")
@pytest.mark.parametrize("mode", [NONE, FILE, MESSAGE])
def test_a_bag_that_grows_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: CompressionMode
) -> None:
    monkeypatch.setattr("coec.io.recordings.bag_storage.MAX_RATIO", 2)
    monkeypatch.setattr("coec.io.recordings.bag_storage.MAX_UNPACKED_MESSAGE_BYTES", 30_000)
    monkeypatch.setattr("coec.io.recordings.bag_storage.MAX_CHUNK_BYTES", 30_000)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    zeros = replace(compressed_image_message(5), data=np.zeros(20_000, np.uint8))
    drive = [*drive_messages(), *[("/front/image", zeros)] * 9]
    if mode is NONE:
        path = Bag(drive, compression=CompressionType.ZSTD).write(tmp_path / "drive.mcap")
    else:
        path = a_folder(tmp_path / "drive", MCAP, mode, drive)
    with pytest.raises(SourceError, match=r"unpacks to more than .* (times its size|bytes)"):
        open_source(str(path))
    assert not list(tmp_path.glob("coec-bag-*"))


@pytest.mark.fault("a bag's metadata that names a million files, or one twice", "refused before they are opened")
def test_metadata_with_too_many_files_is_refused(tmp_path: Path) -> None:
    head = "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: "
    for names, stated in (("[a, b, x/a]", "names a file twice"), (f"[{'a,' * 10_001}]", "relative_file_paths")):
        (tmp_path / "metadata.yaml").write_text(f"{head}{names}}}")
        with pytest.raises(SourceError, match=stated):
            open_source(str(tmp_path))
