"""Packets of Hesai's LiDARs, packed by hand after their manuals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.types import LidarFrame
from coec.errors import DecodeError
from coec.io.ros import hesai_packets, messages
from coec.io.ros.translations import TRANSLATIONS, translation_of
from support.packets import (
    HESAI,
    HESAIS,
    NEBULA,
    P40,
    P128,
    PANDAR,
    QT64,
    XT16,
    XT32,
    Hesai,
    correction_file,
    hesai_message,
    hesai_message_of_ros_1,
)

BEGIN_NS = 1_700_000_000 * 10**9 + 123_456_000
STEP_NS = 2_500_000.0


def turn(sensor: Hesai, columns: int = 0) -> tuple[np.ndarray, list[bytes]]:
    """Ranges in units of 4 mm, and the packets of a turn."""
    rng = np.random.default_rng(2)
    units = rng.integers(100, 30_000, (columns or 5 * sensor.blocks, sensor.lasers))
    units[rng.random(units.shape) < 0.2] = 0
    return units, sensor.packets(units, units % 251, BEGIN_NS, STEP_NS)


def directions(sensor: Hesai) -> tuple[list[float], list[float]]:
    """Of one unit: not those of its model."""
    numbers = np.arange(sensor.lasers)
    return (20.0 - 0.3 * numbers).tolist(), (numbers % 4 - 1.5).tolist()


def sweep_of(message: bytes, correction: bytes | None = None) -> LidarFrame:
    sensor = hesai_packets.sensor_of([hesai_packets.glimpse(message)], correction)
    return sensor.sweep([message], BEGIN_NS, BEGIN_NS)


@pytest.mark.parametrize("name", HESAIS)
def test_the_points_of_a_turn(name: str) -> None:
    sensor = HESAIS[name]
    units, packets = turn(sensor)
    elevations, azimuths = directions(sensor)
    sweep = sweep_of(hesai_message(packets), correction_file(elevations, azimuths))
    column, laser = np.nonzero(units)
    expected = []
    for at, number in zip(column.tolist(), laser.tolist(), strict=True):
        azimuth = np.radians(round(36_000 * at / len(units)) / 100.0 + azimuths[number])
        elevation, away = np.radians(elevations[number]), 0.004 * units[at, number]
        level = away * np.cos(elevation)
        expected.append((level * np.sin(azimuth), level * np.cos(azimuth), away * np.sin(elevation)))
    np.testing.assert_allclose(sweep.xyz_m, expected, atol=2e-4)
    assert sweep.ring is not None
    assert sweep.intensity is not None
    assert sweep.time_offset_s is not None
    np.testing.assert_array_equal(sweep.ring, laser)
    np.testing.assert_array_equal(sweep.intensity, units[column, laser] % 251)
    # Between the packets it is that of the packets, within one that of the model's blocks.
    packet, block = np.divmod(column, sensor.blocks)
    anchor = 0 if sensor is QT64 else sensor.blocks - 1
    within_s = np.array([sensor.block_s(one) - sensor.block_s(anchor) for one in range(sensor.blocks)])
    expected_s = (packet * sensor.blocks + anchor) * STEP_NS * 1e-9 + within_s[block]
    np.testing.assert_allclose(sweep.time_offset_s, expected_s, atol=2e-6)
    assert (sweep.stamp_ns, sweep.frame_id) == (BEGIN_NS, "hesai")


@pytest.mark.parametrize(
    ("name", "laser", "elevation", "azimuth"),
    [
        ("40P", 0, 15.0, -1.042),
        ("40P", 6, 1.67, 3.125),
        ("40P", 7, 1.33, -5.208),
        ("40P", 39, -25.0, -1.042),
        ("64", 0, 14.882, -1.042),
        ("64", 8, 1.522, 5.208),
        ("64", 53, -6.061, -1.042),
        ("QT64", 0, -52.121, 8.736),
        ("QT64", 63, 52.133, -7.892),
        ("XT-16", 15, -15.0, 0.0),
        ("XT-32", 31, -16.0, 0.0),
        ("XTM", 31, -20.8, 0.0),
    ],
)
def test_without_a_correction_file_directions_are_those_of_the_model(
    name: str, laser: int, elevation: float, azimuth: float
) -> None:
    _, packets = turn(HESAIS[name])
    sensor = hesai_packets.sensor_of([hesai_packets.glimpse(hesai_message(packets))], None)
    read = np.degrees([sensor.elevation_rad[laser], sensor.azimuth_rad[laser]])
    np.testing.assert_allclose(read, [elevation, azimuth], atol=0.007)
    assert sensor.notes[0].code == "nominal_angles"
    assert "?metadata=FILE" in sensor.notes[0].text


def test_a_pandar_128_needs_its_correction_file() -> None:
    with pytest.raises(DecodeError, match=r"Hesai Pandar128 need the directions of its lasers: give its correction"):
        sweep_of(hesai_message(turn(P128)[1]))


@pytest.mark.parametrize("form", ["Laser id", "EEFF,1,1\nChannel"])
def test_forms_of_correction_files(form: str) -> None:
    angles = directions(XT32)
    message = hesai_message(turn(XT32)[1])
    text = correction_file(*angles, form=form) + b"0123456789abcdef\n"
    expected = sweep_of(message, correction_file(*angles))
    np.testing.assert_array_equal(sweep_of(message, b"\0\1\0\0" + text).xyz_m, expected.xyz_m)


@pytest.mark.parametrize("text", [correction_file([1.0] * 16, [0.0] * 16), b"", b"1,nan,0\n" * 40, b"\xff" * 99])
def test_a_correction_file_of_another_unit_is_refused(text: bytes) -> None:
    with pytest.raises(DecodeError, match=r"has \d+ of the 32 lasers of the PandarXT-32: is it of another"):
        sweep_of(hesai_message(turn(XT32)[1]), text)


@pytest.mark.parametrize(("type_name", "fixed"), [(HESAI, 0), (PANDAR, 0), (NEBULA, 0), (PANDAR, 1500)])
def test_every_message_holds_the_same(type_name: str, fixed: int) -> None:
    _, packets = turn(XT16)
    sweep = sweep_of(hesai_message(packets, type_name, fixed))
    np.testing.assert_array_equal(sweep.xyz_m, sweep_of(hesai_message(packets)).xyz_m)


def test_an_early_message_has_no_header() -> None:
    _, packets = turn(XT16)
    message = hesai_message(packets)
    begin = 4 + 8 + 4 + 8  # encapsulation, stamp, and the frame with its zero and padding
    sweep = sweep_of(message[:4] + message[begin:])
    np.testing.assert_array_equal(sweep.xyz_m, sweep_of(message).xyz_m)
    assert sweep.frame_id == "hesai_lidar"


def test_a_message_of_ros_1_is_the_same() -> None:
    _, packets = turn(P40)
    number = translation_of("ros1", "pandar_msgs/PandarScan")
    assert number is not None
    message = TRANSLATIONS[number].convert(hesai_message_of_ros_1(packets))
    assert TRANSLATIONS[number].type_name == messages.NEBULA_PACKETS
    np.testing.assert_array_equal(sweep_of(message).xyz_m, sweep_of(hesai_message(packets)).xyz_m)
    for size in range(0, 200, 7):
        with pytest.raises(DecodeError):
            TRANSLATIONS[number].convert(hesai_message_of_ros_1(packets)[:size])


def test_dual_returns_share_their_time_and_equal_ones_count_once() -> None:
    units = np.full((8, 32), 1000)
    units[1] = 1500
    packet = XT32.packet([0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0], units, units % 251, BEGIN_NS, mode=0x39)
    sweep = sweep_of(hesai_message([packet]))
    assert len(sweep.xyz_m) == 5 * 32
    assert sweep.time_offset_s is not None
    times_us = 1e6 * sweep.time_offset_s[::32]
    np.testing.assert_allclose(times_us, [29.0 - 50.0 * blocks for blocks in (3, 3, 2, 1, 0)], atol=0.01)


def test_packets_of_something_else_are_left_out() -> None:
    units, packets = turn(XT32)
    gps = b"\xee\xff" + bytes(510)
    assert len(sweep_of(hesai_message([packets[0], gps, packets[1]])).xyz_m) == (units[:16] > 0).sum()


@pytest.mark.parametrize(
    ("year", "expected_ns"), [(123, BEGIN_NS), (0, BEGIN_NS // 10**9 % 2**32 * 10**9 + 123_456_000)]
)
def test_dates_count_from_1900_or_are_seconds(year: int, expected_ns: int) -> None:
    message = bytearray(hesai_message(turn(XT32)[1][:1]))
    date_at = len(message) - 4 - 4 - 1 - 4 - 6
    if year == 0:
        message[date_at : date_at + 6] = b"\0\0" + (BEGIN_NS // 10**9).to_bytes(4, "big")
    assert message[date_at] == year
    glimpses = [hesai_packets.glimpse(bytes(message))]
    times_ns, numbers = hesai_packets.sensor_of(glimpses, None).heads(glimpses)
    assert numbers.tolist() == [0]
    assert times_ns[0, 0] == pytest.approx(expected_ns + 7 * STEP_NS - 350_000, abs=2000)


@pytest.mark.parametrize(
    ("packet", "cause"),
    [
        (bytes([0xEE, 0xFF, 4, 3]) + bytes(1100), "a Hesai AT128 are not read: let hesai_ros_driver or nebula_ros"),
        (bytes([0xEE, 0xFF, 3, 2]) + bytes(1100), "a Hesai QT128 are not read"),
        (bytes([0xEE, 0xFF, 9, 9]) + bytes(1100), r"a Hesai of the protocol 9\.9 are not read"),
        (XT32.head + bytes(600), "no packets of points of a Hesai"),
        (bytes(1262), "no packets of points of a Hesai"),
        (b"", "no packets of points of a Hesai"),
    ],
)
def test_what_is_not_read_is_refused_by_name(packet: bytes, cause: str) -> None:
    with pytest.raises(DecodeError, match=cause):
        sweep_of(hesai_message([packet]))


@pytest.mark.parametrize("size", range(0, 1300, 37))
def test_a_message_that_is_cut_off_is_refused(size: int) -> None:
    with pytest.raises(DecodeError):
        sweep_of(hesai_message(turn(XT32)[1])[:size])


@pytest.mark.fault("packets of a Hesai with damaged bytes", "they are refused, or their points are finite")
@given(st.integers(0, 2800), st.binary(min_size=1, max_size=16), st.sampled_from(sorted(HESAIS)))
def test_damaged_packets_raise_nothing_else(place: int, value: bytes, name: str) -> None:
    sensor = HESAIS[name]
    message = bytearray(hesai_message(turn(sensor, 2 * sensor.blocks)[1]))
    message[place : place + len(value)] = value
    try:
        glimpses = [hesai_packets.glimpse(bytes(message))]
        read = hesai_packets.sensor_of(glimpses, correction_file(*directions(sensor)))
        times_ns, _ = read.heads(glimpses)
        sweep = read.sweep([bytes(message)], int(times_ns.mean()), BEGIN_NS)
    except DecodeError:
        return
    assert np.isfinite(sweep.xyz_m).all()
    assert sweep.time_offset_s is not None
    assert np.abs(sweep.time_offset_s).max() <= 10.0
