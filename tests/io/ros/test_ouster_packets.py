"""Packets of Ouster's LiDARs, packed by hand after its firmware manual."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import DecodeError
from coec.io.ros.ouster_packets import OusterSensor, glimpse
from support.packets import PIXELS, Ouster, ouster_message
from support.ros import STAMP_NS

STEP_NS = 1_562_500


def ranges_mm(sensor: Ouster) -> np.ndarray:
    rng = np.random.default_rng(5)
    unit = PIXELS[sensor.profile][2]
    ranges = unit * rng.integers(400 // unit, 120_000 // unit, (sensor.columns, len(sensor.altitudes)))
    ranges[rng.random(ranges.shape) < 0.2] = 0
    return np.asarray(ranges)


def turn(sensor: Ouster, frame: int = 9) -> list[bytes]:
    ranges = ranges_mm(sensor)
    packets = sensor.packets(ranges, np.arange(ranges.size).reshape(ranges.shape) % 251, STAMP_NS, frame, STEP_NS)
    return [ouster_message(packet) for packet in packets]


@pytest.mark.parametrize("profile", PIXELS)
def test_the_points_of_a_turn(profile: str) -> None:
    sensor = Ouster(profile)
    sweep = OusterSensor.from_metadata(sensor.metadata()).sweep(turn(sensor), STAMP_NS, STAMP_NS)
    number, beam = np.nonzero(ranges_mm(sensor))
    np.testing.assert_allclose(sweep.xyz_m, sensor.points(ranges_mm(sensor)), atol=1e-5)
    assert sweep.ring is not None
    assert sweep.intensity is not None
    assert sweep.time_offset_s is not None
    np.testing.assert_array_equal(sweep.ring, beam)
    np.testing.assert_array_equal(sweep.intensity, (number * len(sensor.altitudes) + beam) % 251)
    np.testing.assert_allclose(sweep.time_offset_s, number * STEP_NS * 1e-9, atol=1e-8)
    assert (sweep.stamp_ns, sweep.frame_id) == (STAMP_NS, "os_lidar")


def test_the_points_are_those_of_the_makers_library() -> None:
    """`XYZLut` of ouster-sdk 1.0.1, of a sensor with these metadata: columns 0 and 17, in the sensor's frame."""
    sensor = Ouster()
    ranges = np.zeros((sensor.columns, 4), int)
    ranges[0], ranges[17] = (5000, 12_345, 700, 60_000), (1, 800, 33_333, 2500)
    packets = sensor.packets(ranges, ranges, STAMP_NS, 1, STEP_NS)
    read = OusterSensor.from_metadata(sensor.metadata())
    sweep = read.sweep([ouster_message(packet) for packet in packets], STAMP_NS, STAMP_NS)
    points = sweep.xyz_m @ read.T_sensor_lidar[:3, :3].T + read.T_sensor_lidar[:3, 3]
    np.testing.assert_allclose(points, SDK_POINTS, atol=1e-4)


SDK_POINTS = [
    (-4.7831, 0.2635, 1.4680),
    (-12.3035, 0.2263, 1.0070),
    (-0.6921, -0.0125, -0.0471),
    (-57.4075, -3.1725, -17.1037),
    (-0.0009, 0.0001, 0.0390),
    (0.0923, 0.7905, 0.1048),
    (2.6324, 32.9301, -4.3890),
    (0.1037, 2.3924, -0.6660),
]


@pytest.mark.parametrize("profile", ["LEGACY", "RNG15_RFL8_NIR8"])
def test_what_a_glimpse_of_each_packet_shows(profile: str) -> None:
    sensor = Ouster(profile)
    glimpses = [glimpse(message) for message in turn(sensor, frame=65_535)] + [glimpse(ouster_message(bytes(48)))]
    times_ns, numbers = OusterSensor.from_metadata(sensor.metadata()).heads(glimpses)
    assert numbers.tolist() == [65_535] * 4 + [-1]
    assert times_ns[:, 0].tolist() == [STAMP_NS + 16 * packet * STEP_NS for packet in range(4)] + [0]
    with pytest.raises(DecodeError, match=r"no packet has the \d+ bytes that the metadata of the Ouster say"):
        OusterSensor.from_metadata(Ouster(columns=32, in_packet=8).metadata()).heads(glimpses)


def test_columns_that_were_not_measured_are_left_out() -> None:
    sensor = Ouster()
    ranges = np.full((sensor.columns, 4), 5000)
    packets = sensor.packets(ranges, ranges, STAMP_NS, 1, STEP_NS)
    unmeasured = bytearray(packets[1])
    unmeasured[32 + 10] = 0  # status of its first column
    read = OusterSensor.from_metadata(sensor.metadata())
    sweep = read.sweep(list(map(ouster_message, [packets[0], bytes(unmeasured), packets[3]])), STAMP_NS, STAMP_NS)
    assert len(sweep.xyz_m) == (3 * 16 - 1) * 4


def test_metadata_of_old_firmware() -> None:
    """One flat object, without the layout of packets: 16 columns, LEGACY."""
    sensor = Ouster("LEGACY", columns=512, beam_origin=(12.163, 0.0))
    document = json.loads(sensor.metadata())
    flat = {**document["beam_intrinsics"], **document["lidar_intrinsics"], "lidar_mode": "512x10"}
    del flat["beam_to_lidar_transform"]
    old, new = (OusterSensor.from_metadata(text) for text in (json.dumps(flat).encode(), sensor.metadata()))
    assert (old.profile, old.packet, old.columns) == (new.profile, new.packet, new.columns)
    assert old.beam_origin_m == pytest.approx(new.beam_origin_m)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (b"", "no metadata of an Ouster"),
        (b"[" * 100_000, "no metadata of an Ouster"),
        (b"[1]", "no metadata of an Ouster"),
        (b"{}", "no 'beam_altitude_angles'"),
        (Ouster(altitudes=[]).metadata(), "no metadata of an Ouster"),
        (Ouster(altitudes=[1.0]).metadata(), "more angles than beams"),
        (Ouster(altitudes=[float("nan")] * 4).metadata(), "no metadata of an Ouster"),
        (Ouster(beam_origin=(1e300, 0.0)).metadata(), "no metadata of an Ouster"),
        (Ouster().metadata(lidar_intrinsics={"lidar_to_sensor_transform": [2.0] * 16}), "no metadata of an Ouster"),
        (Ouster(columns=10**9).metadata(), "no metadata of an Ouster"),
        (Ouster(in_packet=10**9).metadata(), "no metadata of an Ouster"),
        (Ouster("RNG99").metadata(), r"the profile 'RNG99': LEGACY, .*RNG15_RFL8_NIR8_ZONE16 are read"),
        (Ouster().metadata(lidar_data_format={"columns_per_frame": 64, "pixels_per_column": 3}), "no metadata of an"),
    ],
)
def test_what_are_no_metadata_is_refused(text: bytes, cause: str) -> None:
    with pytest.raises(DecodeError, match=cause):
        OusterSensor.from_metadata(text)


@pytest.mark.fault("packets of an Ouster with damaged bytes", "they are refused, or their points are finite")
@given(st.integers(0, 900), st.binary(min_size=1, max_size=16), st.sampled_from(sorted(PIXELS)))
def test_damaged_packets_raise_nothing_else(place: int, value: bytes, profile: str) -> None:
    sensor = Ouster(profile)
    message = bytearray(turn(sensor)[0])
    message[place : place + len(value)] = value
    read = OusterSensor.from_metadata(sensor.metadata())
    try:
        read.heads([glimpse(bytes(message))])
        sweep = read.sweep([bytes(message)], STAMP_NS, STAMP_NS)
    except DecodeError:
        return
    assert np.isfinite(sweep.xyz_m).all()
    assert sweep.time_offset_s is not None
    assert np.abs(sweep.time_offset_s).max() <= 10.0
