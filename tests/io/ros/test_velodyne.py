"""Scans of Velodyne's packets, packed by hand after the VLP-16's manual (63-9243, chapter 9)."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError, SourceError
from coec.io.recordings.layouts import open_source
from coec.io.ros import messages
from coec.io.ros.message_decoding import decode
from coec.io.ros.translations import TRANSLATIONS, translation_of
from support.recordings import Bag, drive_messages
from support.ros import STAMP_NS, velodyne_packet, velodyne_scan

LIMITS = LimitsConfig()


def sweep_of(payload: bytes) -> LidarFrame:
    pytest.importorskip("velodyne_decoder", reason="needs the extra velodyne")
    frame = decode(messages.VELODYNE_SCAN, payload, LIMITS)
    assert isinstance(frame, LidarFrame)
    return frame


@pytest.mark.parametrize("stamped_first", [False, True])
def test_a_turn_of_a_vlp_16(stamped_first: bool) -> None:
    sweep = sweep_of(velodyne_scan(stamped_first=stamped_first))
    assert (sweep.stamp_ns, sweep.frame_id) == (STAMP_NS, "velodyne")
    assert len(sweep.xyz_m) == 75 * 384
    # Beams leave the sensor 4 cm from its axis.
    np.testing.assert_allclose(np.linalg.norm(sweep.xyz_m, axis=1), 5.0, atol=0.05)
    assert sweep.ring is not None
    assert np.unique(sweep.ring).tolist() == list(range(16))
    elevation_deg = np.degrees(np.arcsin(sweep.xyz_m[:, 2] / np.linalg.norm(sweep.xyz_m, axis=1)))
    by_ring = [float(np.median(elevation_deg[sweep.ring == ring])) for ring in range(16)]
    np.testing.assert_allclose(by_ring, np.arange(-15, 16, 2), atol=0.3)
    # Clockwise from x forward, seen from above.
    assert sweep.time_offset_s is not None
    azimuth = np.unwrap(np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]).astype(np.float64)[sweep.ring == 0])
    assert (np.diff(azimuth) < 0.0).mean() > 0.95
    begin_s = 0.0 if stamped_first else -0.0982
    np.testing.assert_allclose(
        [sweep.time_offset_s.min(), sweep.time_offset_s.max()], [begin_s, begin_s + 0.0995], atol=2e-3
    )


@pytest.mark.parametrize(
    ("payload", "cause"),
    [
        (velodyne_scan(2)[:-1], "cut off"),
        (velodyne_scan(2)[:100], "cut off"),
        (velodyne_scan(0), "0 packets; a scan has up to"),
        (velodyne_scan(1, packet=bytes(1206)), "not read: Data from an unsupported Velodyne model"),
        (velodyne_scan(1, packet=velodyne_packet(0, model=0x99)), "not read: Data from an unsupported"),
        (velodyne_scan(1, packet=velodyne_packet(0, distance_m=0.0)), "no point"),
        (velodyne_scan(2)[:28] + b"\xff" * 8 + velodyne_scan(2)[36:], "packets; a scan has up to|is longer|cut off"),
    ],
)
def test_what_is_no_scan_is_refused(payload: bytes, cause: str) -> None:
    with pytest.raises(DecodeError, match=cause):
        sweep_of(payload)


def test_a_scan_of_ros_1_is_the_same() -> None:
    payload = velodyne_scan(3)
    of_ros_1 = struct.pack("<IIII", 7, *struct.unpack_from("<II", payload, 4), 8) + b"velodyne" + struct.pack("<I", 3)
    # In CDR, stamps are aligned to four bytes behind a packet of 1206.
    begin = len(payload) - 3 * 1214 - 2 * 2
    of_ros_1 += b"".join(payload[begin + 1216 * number :][:1214] for number in range(3))
    number = translation_of("ros1", "velodyne_msgs/VelodyneScan")
    assert number is not None
    expected, sweep = sweep_of(payload), sweep_of(TRANSLATIONS[number].convert(of_ros_1))
    np.testing.assert_array_equal(sweep.xyz_m, expected.xyz_m)
    assert sweep.stamp_ns == expected.stamp_ns


def bag_of_scans(path: Path, *, with_points: bool = False) -> str:
    topics = [(topic, message) for topic, message in drive_messages() if with_points or topic != "/points"]
    Bag(topics).write(path)
    scans = path.with_name(f"scans_{path.name}")
    with scans.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(messages.VELODYNE_SCAN, "ros2msg", b"")
        channel = writer.register_channel("/packets", "cdr", schema)
        writer.add_message(channel, 0, velodyne_scan(), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return str(path.parent)


def test_a_topic_of_points_comes_before_one_of_packets_and_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("both", "alone"):
        (tmp_path / name).mkdir()
    both = open_source(bag_of_scans(tmp_path / "both" / "drive.mcap", with_points=True))
    assert both.rig.lidar_frame == "lidar"
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(SourceError, match=r"pip install 'coec\[velodyne\]'; or convert them with velodyne_pointcloud"):
        open_source(bag_of_scans(tmp_path / "alone" / "drive.mcap"))
