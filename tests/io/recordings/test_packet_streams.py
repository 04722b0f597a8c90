"""Recordings of a LiDAR's packets: sweeps, clocks, metadata; and the same drive as points and in packets."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import coec
from coec.calibration.types import LidarFrame
from coec.errors import SourceError
from coec.io.recordings.layouts import open_lidars, open_source
from coec.io.recordings.recording_source import RecordingSource
from coec.io.ros import messages
from coec.io.ros.ouster_packets import OusterSensor
from coec.io.ros.topics import FrameTopics, PairTopics
from support.packets import (
    HELIOS,
    HESAI,
    OUSTER,
    ROBOSENSE,
    RS_32,
    STRING,
    XT32,
    Entry,
    Ouster,
    bytes_message,
    correction_file,
    gridded,
    hesai_message,
    ouster_message,
    robosense_message,
    string_message,
    write_entries,
)
from support.recordings import STORE, T_BASE_LIDAR, TREE, drive_messages, transform_message
from support.simulated_drives import rendered_source

STORE_WITH_PACKETS = get_typestore(Stores.ROS2_HUMBLE)
STORE_WITH_PACKETS.register(
    get_types_from_msg("std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n", ROBOSENSE)
)
SECOND_NS, SWEEP_NS = 10**9, 100_000_000
TO_MIDDLE_NS = 3 * SWEEP_NS // 8
"""From the first column of the first of four packets to that between the first and the last."""

BEGIN_NS = 1_700_000_000 * SECOND_NS
PACKETS, METADATA = "/ouster/lidar_packets", "/ouster/metadata"
SENSOR = Ouster()
SENSOR_TREE = [*TREE[1:], transform_message("base", "os_sensor", T_BASE_LIDAR)]
IMU_PACKET: Entry = (BEGIN_NS, "/ouster/imu_packets", OUSTER, ouster_message(bytes(48)))
HEAD: Entry = (BEGIN_NS, METADATA, STRING, string_message(SENSOR.metadata()))


def turn(index: int, begin_ns: int) -> list[bytes]:
    """Packets of a room of 5 m whose walls move."""
    ranges = np.full((SENSOR.columns, len(SENSOR.altitudes)), 5000 + 100 * index)
    return SENSOR.packets(ranges, ranges // 100, begin_ns, (65_533 + index) % 65_536, SWEEP_NS // SENSOR.columns)


def packets(
    turns: int = 6, topic: str = PACKETS, sensor_begin_ns: int = BEGIN_NS, late_ns: tuple[int, ...] = (300_000,)
) -> list[Entry]:
    """Packets of some turns at 10 Hz, each received as long after its last column as `late_ns` says in turn."""
    entries: list[Entry] = []
    for index in range(turns):
        for number, packet in enumerate(turn(index, sensor_begin_ns + index * SWEEP_NS)):
            sent_ns = BEGIN_NS + index * SWEEP_NS + (number + 1) * SWEEP_NS // 4
            received_ns = sent_ns + late_ns[len(entries) % len(late_ns)]
            entries.append((received_ns, topic, OUSTER, ouster_message(packet)))
    return entries


def others(tree: list[Any] = SENSOR_TREE) -> list[Entry]:
    """Images at 10 Hz with odometry."""
    entries: list[Entry] = []
    for topic, message in drive_messages(tree=tree):
        if topic != "/points":
            name = message.__msgtype__
            data = bytearray(STORE.serialize_cdr(message, name))
            if hasattr(message, "header") and message.header.stamp.sec:
                data[4:8] = struct.pack("<i", message.header.stamp.sec - 1 + BEGIN_NS // SECOND_NS)
            entries.append((BEGIN_NS, topic, name, bytes(data)))
    return entries


def sweeps_of(recording: RecordingSource) -> list[LidarFrame]:
    return [frame for frame in recording.messages() if isinstance(frame, LidarFrame)]


def codes(recording: Any) -> dict[str, str]:
    return {one.code: one.text for one in recording.recognitions}


@pytest.mark.parametrize("late", [False, True])
def test_a_recording_of_packets_is_one_of_sweeps(tmp_path: Path, late: bool) -> None:
    entries = [*others(), IMU_PACKET, *packets()]
    entries = [*entries, HEAD] if late else [HEAD, *entries]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", entries)))
    sweeps = sweeps_of(recording)
    read = OusterSensor.from_metadata(SENSOR.metadata())
    assert [sweep.stamp_ns for sweep in sweeps] == [BEGIN_NS + index * SWEEP_NS + TO_MIDDLE_NS for index in range(6)]
    for index, sweep in enumerate(sweeps):
        begin_ns = BEGIN_NS + index * SWEEP_NS
        at_ns = begin_ns + TO_MIDDLE_NS
        expected = read.sweep([ouster_message(one) for one in turn(index, begin_ns)], at_ns, at_ns)
        np.testing.assert_array_equal(sweep.xyz_m, expected.xyz_m)
        np.testing.assert_array_equal(sweep.time_offset_s, expected.time_offset_s)
    # The tree has the sensor's frame only; that of the points comes from the metadata.
    assert recording.rig.lidar_frame == "os_lidar"
    expected_pose = np.linalg.inv(T_BASE_LIDAR @ read.T_sensor_lidar)
    T_lidar_camera = np.linalg.inv(recording.rig.T_camera_lidar_nominal)
    base = SENSOR_TREE[0].transform.translation, SENSOR_TREE[1].transform.translation
    camera = np.array([getattr(base[0], axis) + getattr(base[1], axis) for axis in "xyz"] + [1.0])
    np.testing.assert_allclose(T_lidar_camera[:3, 3], (expected_pose @ camera)[:3], atol=1e-6)
    assert set(codes(recording)) <= {"already_compensated"}


def test_ros_1_is_the_same(tmp_path: Path) -> None:
    entries = [
        (time, topic, name.replace("/msg/", "/"), bytes(STORE.cdr_to_ros1(data, name)))
        for time, topic, name, data in [*others(), HEAD]
    ]
    bare = [(time, topic, "ouster_ros/PacketMsg", data[4:]) for time, topic, _, data in packets()]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", [*entries, *bare], "ros1")))
    native = open_source(str(write_entries(tmp_path / "native.mcap", [HEAD, *others(), *packets()])))
    for sweep, expected in zip(sweeps_of(recording), sweeps_of(native), strict=True):
        np.testing.assert_array_equal(sweep.xyz_m, expected.xyz_m)


def test_without_metadata_the_error_says_what_to_do(tmp_path: Path) -> None:
    path = write_entries(tmp_path / "drive.mcap", [*others(), *packets()])
    for query in ("", f"?points={PACKETS}"):
        with pytest.raises(SourceError, match=rf"{PACKETS}.* has packets of a LiDAR: .*no metadata: .* or give"):
            open_source(f"{path}{query}")
    saved = tmp_path / "os.json"
    saved.write_bytes(SENSOR.metadata())
    assert len(sweeps_of(open_source(f"{path}?metadata={saved}"))) == 6
    saved.write_bytes(Ouster("LEGACY").metadata())
    with pytest.raises(SourceError, match=r"no packet has the .* bytes that the metadata of the Ouster say .LEGACY"):
        open_source(f"{path}?metadata={saved}")
    with pytest.raises(SourceError, match="cannot read metadata=/nowhere"):
        open_source(f"{path}?metadata=/nowhere")


def test_two_sensors_have_each_their_own_metadata(tmp_path: Path) -> None:
    of_other = (BEGIN_NS, "/rear/metadata", STRING, string_message(Ouster(beam_origin=(0.0, 0.0)).metadata()))
    elsewhere = (BEGIN_NS, "/else/metadata", STRING, string_message(SENSOR.metadata()))
    both = [HEAD, of_other, *others(), *packets(), *packets(topic="/rear/lidar_packets")]
    path = write_entries(tmp_path / "both.mcap", both)
    front, rear = (sweeps_of(open_source(f"{path}?points=/{name}/lidar_packets"))[0] for name in ("ouster", "rear"))
    assert np.abs(front.xyz_m - rear.xyz_m).max() > 0.005
    assert len(open_lidars(str(path), PACKETS, "/rear/lidar_packets").pairs(3)) == 3
    unclear = write_entries(tmp_path / "unclear.mcap", [of_other, elsewhere, *others(), *packets()])
    with pytest.raises(SourceError, match="messages say what the LiDAR is, /rear/metadata, /else/metadata: choose"):
        open_source(str(unclear))
    selected = sweeps_of(open_source(f"{unclear}?metadata=/rear/metadata"))[0]
    np.testing.assert_array_equal(selected.xyz_m, rear.xyz_m)


def test_a_clock_that_counts_from_its_start_is_tied_to_that_of_the_recorder(tmp_path: Path) -> None:
    late_ns = (5_000_000, 900_000, 12_000_000, 700_000, 3_000_000)
    entries = [HEAD, *others(), *packets(sensor_begin_ns=77 * SECOND_NS, late_ns=late_ns)]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", entries)))
    assert "counts from its start" in codes(recording)["lidar_clock"]
    for index, sweep in enumerate(sweeps_of(recording)):
        late_s = (sweep.stamp_ns - BEGIN_NS - index * SWEEP_NS - TO_MIDDLE_NS) * 1e-9
        assert late_s == pytest.approx(0.0007, abs=1e-6)
        assert sweep.time_offset_s is not None
        np.testing.assert_allclose(np.ptp(sweep.time_offset_s), 0.1 * 63 / 64, atol=1e-6)


def test_a_difference_between_clocks_is_named_as_it_is_of_clouds(tmp_path: Path) -> None:
    entries = [HEAD, *others(), *packets(sensor_begin_ns=BEGIN_NS + 37 * SECOND_NS)]
    path = write_entries(tmp_path / "drive.mcap", entries)
    assert "TAI" in codes(open_source(str(path)))["header_clock"]
    moved = sweeps_of(open_source(f"{path}?lidar_offset=-37"))
    assert [sweep.stamp_ns - TO_MIDDLE_NS for sweep in moved] == [BEGIN_NS + index * SWEEP_NS for index in range(6)]


def test_what_somebody_else_says_of_elevations_is_not_the_lidars(tmp_path: Path) -> None:
    other = (BEGIN_NS, "/survey", STRING, string_message(b'{"Elevation": 5, "beam_altitude": 3}'))
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", [other, *others(), *hesai_turns()])))
    assert "nominal_angles" in codes(recording)


def test_a_restarted_sensor_has_another_clock(tmp_path: Path) -> None:
    before, after = packets(3, sensor_begin_ns=500 * SECOND_NS), packets(3, sensor_begin_ns=9 * SECOND_NS)
    entries = [HEAD, *others(), *before, *((time + SECOND_NS, *rest) for time, *rest in after)]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", entries)))  # type: ignore[arg-type]
    stamps_s = [(sweep.stamp_ns - BEGIN_NS) * 1e-9 for sweep in sweeps_of(recording)]
    np.testing.assert_allclose(np.diff(stamps_s), [0.1, 0.1, 0.8, 0.1, 0.1], atol=1e-3)


def test_lost_late_and_foreign_packets(tmp_path: Path) -> None:
    sent = packets()
    # The recorder started and ended in a turn; a packet is lost, one comes in the next turn, one is of something else.
    recorded = sent[1:-2]
    lost, late = recorded.pop(5), recorded.pop(9)
    recorded.insert(10, late)
    recorded.insert(12, (lost[0], PACKETS, OUSTER, ouster_message(bytes(600))))
    recorded.insert(15, (lost[0], PACKETS, OUSTER, lost[3][:-40]))
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", [HEAD, *others(), *recorded])))
    assert [len(sweep.xyz_m) for sweep in sweeps_of(recording)] == [192, 256, 256, 256]
    assert codes(recording)["packets_left_out"].startswith(
        "Of 22 messages of the LiDAR, 1 have packets in another form"
    )
    assert "and 1 are damaged" in codes(recording)["packets_left_out"]


def test_low_data_says_that_ranges_are_coarse(tmp_path: Path) -> None:
    sensor = Ouster("RNG15_RFL8_NIR8")
    ranges = np.full((sensor.columns, 4), 5000)
    sent = [
        (BEGIN_NS, PACKETS, OUSTER, ouster_message(packet))
        for index in range(4)
        for packet in sensor.packets(ranges, ranges // 100, BEGIN_NS + index * SWEEP_NS, index, SWEEP_NS // 64)
    ]
    head = (BEGIN_NS, METADATA, STRING, string_message(sensor.metadata()))
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", [head, *others(), *sent])))
    assert "in steps of 8 mm" in codes(recording)["coarse_ranges"]


def test_a_topic_of_points_comes_before_one_of_packets(tmp_path: Path) -> None:
    cloud = next(message for topic, message in drive_messages() if topic == "/points")
    points = (BEGIN_NS, "/points", messages.POINT_CLOUD, bytes(STORE.serialize_cdr(cloud, messages.POINT_CLOUD)))
    entries = [HEAD, points, *others([*SENSOR_TREE, TREE[0]]), *packets()]
    assert open_source(str(write_entries(tmp_path / "both.mcap", entries))).rig.lidar_frame == "lidar"


def test_damaged_packets_are_named_and_end_nothing_else(tmp_path: Path) -> None:
    sent = packets(1)
    damaged = (*sent[0][:3], sent[0][3][:-40])
    with pytest.raises(SourceError, match=f"{PACKETS} has packets of a LiDAR: the packet is cut off"):
        open_source(str(write_entries(tmp_path / "drive.mcap", [HEAD, *others(), damaged])))
    cloud = next(message for topic, message in drive_messages() if topic == "/points")
    points = (BEGIN_NS, "/points", messages.POINT_CLOUD, bytes(STORE.serialize_cdr(cloud, messages.POINT_CLOUD)))
    entries = [points, *others([*SENSOR_TREE, TREE[0]]), damaged]
    assert open_source(str(write_entries(tmp_path / "both.mcap", entries))).rig.lidar_frame == "lidar"


# --- Hesai ------------------------------------------------------------------------------------------------------------

DIRECTIONS = ([16.0 - 1.1 * laser for laser in range(32)], [0.5] * 32)
HESAI_MIDDLE_S = 0.1 * (7 + 63) / 64 / 2 - 350e-6 / 2
"""From the begin of a turn of 64 columns, in packets of 8, to its middle: between the first and the last block. Blocks
of a packet are 50 us apart."""

CORRECTION: Entry = (
    BEGIN_NS,
    "/lidar_corrections",
    messages.BYTES,
    bytes_message(correction_file(*DIRECTIONS)),
)


def hesai_turns(turns: int = 6, sensor_begin_ns: int = BEGIN_NS, late_ns: int = 2_000_000) -> list[Entry]:
    """Turns of an XT-32 of 64 columns at 10 Hz, each in a message that is received after its end."""
    entries: list[Entry] = []
    for index in range(turns):
        units = np.full((64, 32), 1250 + 25 * index)
        sent = XT32.packets(units, units % 251, sensor_begin_ns + index * SWEEP_NS, SWEEP_NS / 64)
        received_ns = BEGIN_NS + (index + 1) * SWEEP_NS + late_ns
        entries.append(
            (received_ns, "/lidar_packets", HESAI, hesai_message(sent, sec=BEGIN_NS // SECOND_NS, frame="os_sensor"))
        )
    return entries


def test_a_recording_of_packets_of_a_hesai(tmp_path: Path) -> None:
    nominal = write_entries(tmp_path / "nominal.mcap", [*others(), *hesai_turns()])
    recording = open_source(str(nominal))
    assert "nominal directions of the lasers of a PandarXT-32" in codes(recording)["nominal_angles"]
    assert recording.rig.lidar_frame == "os_sensor"
    sweeps = sweeps_of(recording)
    assert [len(sweep.xyz_m) for sweep in sweeps] == [64 * 32] * 6
    stamps_s = [(sweep.stamp_ns - BEGIN_NS) * 1e-9 for sweep in sweeps]
    np.testing.assert_allclose(stamps_s, HESAI_MIDDLE_S + 0.1 * np.arange(6), atol=1e-5)
    corrected = open_source(str(write_entries(tmp_path / "corrected.mcap", [CORRECTION, *others(), *hesai_turns()])))
    assert "nominal_angles" not in codes(corrected)
    given = tmp_path / "Angle Correction File.csv"
    given.write_bytes(correction_file(*DIRECTIONS))
    of_file, of_topic = sweeps_of(open_source(f"{nominal}?metadata={given}")), sweeps_of(corrected)
    for a, b, plain in zip(of_file, of_topic, sweeps, strict=True):
        np.testing.assert_array_equal(a.xyz_m, b.xyz_m)
        assert np.abs(a.xyz_m - plain.xyz_m).max() > 0.01


def test_the_clock_of_a_hesai_that_was_never_set_begins_at_2000(tmp_path: Path) -> None:
    entries = [CORRECTION, *others(), *hesai_turns(sensor_begin_ns=946_684_800 * SECOND_NS + 7 * SECOND_NS)]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", entries)))
    assert "lidar_clock" in codes(recording)
    stamps_s = [(sweep.stamp_ns - BEGIN_NS) * 1e-9 for sweep in sweeps_of(recording)]
    # Late by the 2 ms of its reception, and by the time from the last block to the end of the turn.
    np.testing.assert_allclose(stamps_s, HESAI_MIDDLE_S + 0.002 + 0.1 / 64 + 0.1 * np.arange(6), atol=1e-5)


# --- RoboSense --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_recording_of_packets_of_a_robosense(tmp_path: Path, encoding: str) -> None:
    entries: list[Entry] = []
    for index in range(4):
        units = np.full((48, 32), 1000 + 20 * index)
        sent = RS_32.packets(units, units % 251, BEGIN_NS + index * SWEEP_NS, SWEEP_NS / 48)
        entries += [(BEGIN_NS + (index + 1) * SWEEP_NS, PACKETS, ROBOSENSE, robosense_message(one)) for one in sent]
    entries.insert(5, (BEGIN_NS, PACKETS, ROBOSENSE, robosense_message(RS_32.difop())))
    tree = [*TREE[1:], transform_message("base", "rslidar", T_BASE_LIDAR)]
    every = [*others(tree), *entries]
    if encoding == "ros1":
        every = [
            (time, topic, name.replace("/msg/", "/"), bytes(STORE_WITH_PACKETS.cdr_to_ros1(data, name)))
            for time, topic, name, data in every
        ]
    recording = open_source(str(write_entries(tmp_path / "drive.mcap", every, encoding)))
    sweeps = sweeps_of(recording)
    assert [len(sweep.xyz_m) for sweep in sweeps] == [48 * 32] * 4
    stamps_s = [(sweep.stamp_ns - BEGIN_NS) * 1e-9 for sweep in sweeps]
    # Between the first block and the last one, the last packet's blocks 55.52 us apart.
    np.testing.assert_allclose(stamps_s, (0.075 + 11 * 55.52e-6) / 2 + 0.1 * np.arange(4), atol=2e-6)
    assert recording.rig.lidar_frame == "rslidar"
    assert set(codes(recording)) <= {"already_compensated"}


# --- a drive in packets decides as one of points ----------------------------------------------------------------------

SIM = "sim:seed=3&seconds=30&camera_hz=0.5&lidar_hz=0.5&camera=pinhole640x400@90&lidar=32"
COLUMNS = 1800
"""As the simulator's LiDAR, so that the directions of points stay the same."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8"]
)
def test_a_drive_in_packets_of_an_ouster_decides_within_one_sigma_of_the_same_drive_as_points(
    tmp_path: Path, profile: str, record_property: Any
) -> None:
    drive = rendered_source(SIM)
    sweeps = [frame for frame in drive.messages() if isinstance(frame, LidarFrame)]
    distance = distance_of(tmp_path, drive, ouster_entries(profile, sweeps))
    record_property("figure", f"{profile}: {distance:.2f} standard deviations")
    assert distance < 1.0


def ouster_entries(profile: str, sweeps: list[LidarFrame]) -> list[Entry]:
    altitudes, beams = elevations_of(sweeps), 32
    # Columns of the simulator begin at the rear, half a step before a column of the sensor.
    azimuths = [-180.0 + 180.0 / COLUMNS] * beams
    sensor = Ouster(profile, COLUMNS, altitudes, azimuths, (0.0, 0.0), in_packet=8)
    entries: list[Entry] = [(0, METADATA, STRING, string_message(sensor.metadata()))]
    for index, one in enumerate(sweeps):
        ranges, intensity = gridded(one, COLUMNS, beams)
        begin_ns = one.stamp_ns - SWEEP_NS // 2 + SWEEP_NS // COLUMNS // 2
        unit = 8 if profile.startswith("RNG15") else 1
        in_mm = unit * np.rint(1e3 * ranges / unit).astype(int)
        sent = sensor.packets(in_mm, intensity, begin_ns, index, SWEEP_NS // COLUMNS)
        entries += [(begin_ns + SWEEP_NS, PACKETS, OUSTER, ouster_message(packet)) for packet in sent]
    return entries


@pytest.mark.slow
def test_a_drive_in_packets_of_a_hesai_decides_within_one_sigma_of_the_same_drive_as_points(
    tmp_path: Path, record_property: Any
) -> None:
    drive = rendered_source(SIM)
    sweeps = [frame for frame in drive.messages() if isinstance(frame, LidarFrame)]
    distance = distance_of(tmp_path, drive, hesai_entries(sweeps, drive.rig.lidar_frame))
    record_property("figure", f"PandarXT-32: {distance:.2f} standard deviations")
    assert distance < 1.0


@pytest.mark.slow
def test_a_drive_in_packets_of_a_robosense_decides_within_one_sigma_of_the_same_drive_as_points(
    tmp_path: Path, record_property: Any
) -> None:
    drive = rendered_source(SIM)
    sweeps = [frame for frame in drive.messages() if isinstance(frame, LidarFrame)]
    distance = distance_of(tmp_path, drive, robosense_entries(sweeps, drive.rig.lidar_frame))
    record_property("figure", f"Helios: {distance:.2f} standard deviations")
    assert distance < 1.0


def robosense_entries(sweeps: list[LidarFrame], frame: str) -> list[Entry]:
    """The simulated LiDAR as a Helios, whose lasers are turned so that they fire in one direction."""
    elevations = elevations_of(sweeps)
    along_block = [-360.0 / COLUMNS * each / HELIOS.firing_us for each in HELIOS.lasers_us]
    difop = HELIOS.difop(directions=(elevations, along_block))
    entries: list[Entry] = [(0, PACKETS, ROBOSENSE, robosense_message(difop, frame))]
    for one in sweeps:
        ranges, intensity = gridded(one, COLUMNS, 32)
        begin_ns = one.stamp_ns - SWEEP_NS // 2 + SWEEP_NS // COLUMNS // 2
        from_lens = ranges - HELIOS.lens_m / np.cos(np.radians(elevations))
        units = np.rint(np.where(ranges > 0.0, from_lens, 0.0) / 0.0025).astype(int)
        sent = HELIOS.packets(units, intensity.astype(int), begin_ns, SWEEP_NS / COLUMNS, 180.0 + 180.0 / COLUMNS)
        sweep = [robosense_message(each, frame, begin=each is sent[0]) for each in sent]
        entries += [(begin_ns + SWEEP_NS, PACKETS, ROBOSENSE, message) for message in sweep]
    return entries


def hesai_entries(sweeps: list[LidarFrame], frame: str) -> list[Entry]:
    """The simulated LiDAR as an XT-32, turned by 90°: azimuths count from y."""
    entries: list[Entry] = []
    for one in sweeps:
        ranges, intensity = gridded(one, COLUMNS, 32)
        begin_ns = one.stamp_ns - SWEEP_NS // 2 + SWEEP_NS // COLUMNS // 2
        units = np.rint(ranges / 0.004).astype(int)
        sent = XT32.packets(units, intensity, begin_ns, SWEEP_NS / COLUMNS, 270.0 + 180.0 / COLUMNS)
        message = hesai_message(sent, sec=one.stamp_ns // SECOND_NS, frame=frame)
        entries.append((begin_ns + SWEEP_NS, "/lidar_packets", HESAI, message))
    altitudes = elevations_of(sweeps)
    return [(0, "/lidar_corrections", messages.BYTES, bytes_message(correction_file(altitudes, [0.0] * 32))), *entries]


def elevations_of(sweeps: list[LidarFrame]) -> list[float]:
    """Of each beam, degrees."""
    sweep = sweeps[0]
    assert sweep.ring is not None
    elevation = np.degrees(np.arcsin(sweep.xyz_m[:, 2] / np.linalg.norm(sweep.xyz_m, axis=1)))
    return [float(np.median(elevation[sweep.ring == beam])) for beam in range(32)]


def distance_of(folder: Path, drive: RecordingSource, in_packets: list[Entry]) -> float:
    """Largest distance between the rotations that the drive gives as points and in packets, in standard deviations."""
    topics = FrameTopics(drive.rig, drive.T_camera_lidar_start, PairTopics.default("front"))
    entries: list[Entry] = [
        (each.stamp_ns, each.topic, each.type_name, each.data)
        for frame in drive.messages()
        for each in topics.of(frame)
    ]
    other = [each for each in entries if each[2] != messages.POINT_CLOUD]
    lidar = drive.rig.lidar_frame
    results = [
        coec.open(f"{write_entries(folder / name, of_form)}{query}").calibrate(perturb=(1.0, -1.0, 0.5))
        for name, of_form, query in (
            ("points.mcap", entries, ""),
            ("packets.mcap", [*other, *in_packets], f"?lidar_frame={lidar}"),
        )
    ]
    native, of_packets = results
    assert native.accepted
    assert of_packets.accepted
    return float((np.abs(of_packets.correction[:3] - native.correction[:3]) / native.sigma[:3]).max())
