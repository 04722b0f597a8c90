"""Packets of RoboSense's LiDARs, packed by hand after their manuals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.types import LidarFrame
from coec.errors import DecodeError
from coec.io.ros import robosense_packets
from coec.io.ros.robosense_packets import RobosenseSensor
from support.packets import HELIOS, ROBOSENSES, RS_16, RS_32, Robosense, robosense_message

BEGIN_NS = 1_700_000_000 * 10**9 + 123_456_000
BLOCKS = 36


def block_ns(sensor: Robosense) -> float:
    return 1e3 * sensor.firing_us * sensor.in_block


def turn(sensor: Robosense) -> tuple[np.ndarray, list[bytes]]:
    """Ranges in the sensor's unit, and the messages of a turn."""
    rng = np.random.default_rng(2)
    units = rng.integers(200, 40_000, (BLOCKS, 32))
    units[rng.random(units.shape) < 0.2] = 0
    return units, list(map(robosense_message, sensor.packets(units, units % 251, BEGIN_NS, block_ns(sensor))))


def sensor_of(messages: list[bytes], difop: bytes | None = None) -> RobosenseSensor:
    return robosense_packets.sensor_of([robosense_packets.glimpse(one) for one in messages], difop)


def sweep_of(sensor: Robosense, messages: list[bytes]) -> LidarFrame:
    return sensor_of([*messages, robosense_message(sensor.difop())]).sweep(messages, BEGIN_NS, BEGIN_NS)


@pytest.mark.parametrize("name", ROBOSENSES)
def test_the_points_of_a_turn(name: str) -> None:
    sensor = ROBOSENSES[name]
    units, messages = turn(sensor)
    sweep = sweep_of(sensor, messages)
    elevations, azimuths = sensor.directions()
    ranks = np.argsort(np.argsort(elevations))
    points, rings, times_s = [], [], []
    for block, channel in zip(*(one.tolist() for one in np.nonzero(units)), strict=True):
        firing, laser = divmod(channel, sensor.lasers)
        within_us = sensor.firing_us * firing + sensor.lasers_us[laser]
        lens = np.radians(360.0 / BLOCKS * (block + within_us / (sensor.firing_us * sensor.in_block)))
        turned, up = lens + np.radians(azimuths[laser]), np.radians(elevations[laser])
        away = 1e-3 * sensor.unit_mm * units[block, channel]
        x = away * np.cos(up) * np.cos(turned) + sensor.lens_m * np.cos(lens)
        y = -away * np.cos(up) * np.sin(turned) - sensor.lens_m * np.sin(lens)
        points.append((x, y, away * np.sin(up)))
        rings.append(ranks[laser])
        times_s.append(1e-9 * block * block_ns(sensor) + 1e-6 * within_us)
    # Directions are packed in 0.0001, 0.001 and 0.01 degrees.
    np.testing.assert_allclose(sweep.xyz_m, points, atol=0.02 if sensor is HELIOS else 0.003)
    assert sweep.ring is not None
    assert sweep.intensity is not None
    assert sweep.time_offset_s is not None
    np.testing.assert_array_equal(sweep.ring, rings)
    np.testing.assert_array_equal(sweep.intensity, units[units > 0] % 251)
    np.testing.assert_allclose(sweep.time_offset_s, times_s, atol=1.5e-6)
    assert (sweep.stamp_ns, sweep.frame_id) == (BEGIN_NS, "rslidar")


@pytest.mark.parametrize("name", ROBOSENSES)
def test_sweeps_begin_where_azimuths_do(name: str) -> None:
    sensor = ROBOSENSES[name]
    _, messages = turn(sensor)
    glimpses = list(map(robosense_packets.glimpse, [robosense_message(sensor.difop()), *messages, *messages]))
    glimpses.append(robosense_packets.glimpse(robosense_message(bytes(1248))))
    times_ns, numbers = robosense_packets.sensor_of(glimpses, None).heads(glimpses)
    assert numbers.tolist() == [-2, 0, 0, 0, 1, 1, 1, -1]
    expected_ns = BEGIN_NS + np.array([0.0, 12.0, 24.0]) * block_ns(sensor)
    np.testing.assert_allclose(times_ns[1:4, 0] - BEGIN_NS, expected_ns - BEGIN_NS, atol=1000)
    np.testing.assert_allclose(np.diff(times_ns[1:4]), 11.0 * block_ns(sensor), atol=1)


def test_sweeps_begin_where_the_driver_says_so() -> None:
    units, _ = turn(RS_32)
    sent = RS_32.packets(units, units % 251, BEGIN_NS, block_ns(RS_32))
    messages = [robosense_message(one, begin=index == 1) for index, one in enumerate(sent)]
    glimpses = list(map(robosense_packets.glimpse, [*messages, *messages, robosense_message(RS_32.difop())]))
    _, numbers = robosense_packets.sensor_of(glimpses, None).heads(glimpses)
    assert numbers.tolist() == [0, 1, 1, 1, 2, 2, -2]


def test_dual_returns() -> None:
    units = np.full((12, 32), 1000)
    units[1] = 1500
    packet = RS_32.packet(np.repeat(np.arange(6.0), 2), units, units % 251, BEGIN_NS)
    message = robosense_message(packet)
    sensor = sensor_of([message, robosense_message(RS_32.difop(dual=True))])
    sweep = sensor.sweep([message], BEGIN_NS, BEGIN_NS)
    assert len(sweep.xyz_m) == 7 * 32
    assert sweep.time_offset_s is not None
    np.testing.assert_allclose(1e6 * sweep.time_offset_s[::32], 55.52 * np.array([0, 0, 1, 2, 3, 4, 5]), atol=0.01)
    units = np.full((12, 32), 1000)
    units[:, 16:] = 1500
    message = robosense_message(RS_16.packet(np.arange(12.0), units, units % 251, BEGIN_NS))
    sweep = sensor_of([message, robosense_message(RS_16.difop(dual=True))]).sweep([message], BEGIN_NS, BEGIN_NS)
    assert len(sweep.xyz_m) == 12 * 32
    assert sweep.time_offset_s is not None
    np.testing.assert_allclose(1e6 * sweep.time_offset_s[::16], 55.5 * np.repeat(np.arange(12), 2), atol=0.01)


def test_directions_may_come_late_or_from_a_file() -> None:
    _, messages = turn(RS_32)
    blank = robosense_message(RS_32.difop(blank=True))
    first = sensor_of([*messages, blank, robosense_message(RS_32.difop())])
    second = sensor_of(messages, b"\0\0" + RS_32.difop())
    np.testing.assert_array_equal(first.elevation_rad, second.elevation_rad)
    for without in (messages, [*messages, blank]):
        with pytest.raises(DecodeError, match="no DIFOP packet with the directions of its lasers: record or"):
            sensor_of(without)


def test_another_model_is_refused() -> None:
    bpearl = bytearray(RS_32.difop())
    bpearl[468:564] = b"".join((100 * (3 * laser)).to_bytes(3, "big") for laser in range(32))
    for messages in (
        [*turn(RS_32)[1], robosense_message(bytes(bpearl))],
        [*turn(HELIOS)[1], robosense_message(RS_32.difop())],
        [robosense_message(bytes(1248))],
        [robosense_message(bytes(256))],
    ):
        with pytest.raises(DecodeError, match="no RS-16, RS-32 or Helios of 32 lasers are not read: let rslidar_sdk"):
            sensor_of(messages)


@pytest.mark.parametrize("size", range(0, 1270, 41))
def test_a_message_that_is_cut_off_is_refused(size: int) -> None:
    with pytest.raises(DecodeError):
        robosense_packets.glimpse(turn(RS_16)[1][0][:size])


@pytest.mark.fault("packets of a RoboSense with damaged bytes", "they are refused, or their points are finite")
@given(st.integers(0, 1250), st.binary(min_size=1, max_size=16), st.sampled_from(sorted(ROBOSENSES)), st.booleans())
def test_damaged_packets_raise_nothing_else(place: int, value: bytes, name: str, of_directions: bool) -> None:
    sensor = ROBOSENSES[name]
    messages = [turn(sensor)[1][0], robosense_message(sensor.difop())]
    damaged = bytearray(messages[of_directions])
    damaged[place : place + len(value)] = value
    messages[of_directions] = bytes(damaged)
    try:
        glimpses = list(map(robosense_packets.glimpse, messages))
        read = robosense_packets.sensor_of(glimpses, None)
        times_ns, _ = read.heads(glimpses)
        sweep = read.sweep(messages, int(times_ns[0].mean()), BEGIN_NS)
    except DecodeError:
        return
    assert np.isfinite(sweep.xyz_m).all()
    assert sweep.time_offset_s is not None
    assert np.abs(sweep.time_offset_s).max() <= 10.0
