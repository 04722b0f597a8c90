"""Clouds as published drivers lay them out: names, types, offsets and sizes of points from their sources.

The values are ours. What counts is that every layout is read, and its times, rings and intensities with it.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.io.ros import message_decoding, messages
from support.ros import CODES, STAMP_NS, STAMP_REST_NS, STAMP_S, cloud

BEGIN_S = STAMP_S + STAMP_REST_NS * 1e-9
STEPS = np.linspace(0.0, 1.0, 12)
SWEEP_S = 0.0996


@dataclass(frozen=True)
class Driver:
    """`fields` are (name, NumPy type, offset in the point); `times` those of the first and the last point, as the
    driver would write them."""

    fields: tuple[tuple[str, str, int], ...]
    point_step: int
    times: tuple[str, float, float] | None
    begins_s: float = 0.0
    height: int = 1
    ring: str | None = "ring"


F4_XYZ = (("x", "<f4", 0), ("y", "<f4", 4), ("z", "<f4", 8))
DRIVERS = {
    # ouster-ros, os_point.h: PCL_ADD_POINT4D pads to 16, the whole to 48; organised.
    "ouster": Driver(
        (
            *F4_XYZ,
            ("intensity", "<f4", 16),
            ("t", "<u4", 20),
            ("reflectivity", "<u2", 24),
            ("ring", "<u2", 26),
            ("ambient", "<u2", 28),
            ("range", "<u4", 32),
        ),
        48,
        ("t", 0.0, SWEEP_S * 1e9),
        height=4,
    ),
    # ouster_ros of 2019, point_os1.h: `t` as a float, `ring` of 8 bits.
    "ouster os1": Driver(
        (*F4_XYZ, ("t", "<f4", 16), ("reflectivity", "<u2", 20), ("intensity", "<u2", 22), ("ring", "u1", 24)),
        32,
        ("t", 0.0, SWEEP_S * 1e9),
        height=4,
    ),
    # velodyne_pointcloud, point type XYZIRT: packed, stamped with the last packet.
    "velodyne": Driver(
        (*F4_XYZ, ("intensity", "<f4", 12), ("ring", "<u2", 16), ("time", "<f4", 18)),
        22,
        ("time", -SWEEP_S, 0.0),
        begins_s=-SWEEP_S,
    ),
    # HesaiLidar_ROS_2.0, source_driver_ros2.hpp.
    "hesai": Driver(
        (*F4_XYZ, ("intensity", "<f4", 12), ("ring", "<u2", 16), ("timestamp", "<f8", 18)),
        26,
        ("timestamp", BEGIN_S, BEGIN_S + SWEEP_S),
    ),
    # rslidar_sdk, POINT_TYPE_XYZIRT; stamped with the last point unless ts_first_point is set.
    "robosense": Driver(
        (*F4_XYZ, ("intensity", "<f4", 12), ("ring", "<u2", 16), ("timestamp", "<f8", 18)),
        26,
        ("timestamp", BEGIN_S - SWEEP_S, BEGIN_S),
        begins_s=-SWEEP_S,
        height=2,
    ),
    # livox_ros_driver2, LivoxPointXyzrtlt (packed): nanoseconds as a double.
    "livox": Driver(
        (*F4_XYZ, ("intensity", "<f4", 12), ("tag", "u1", 16), ("line", "u1", 17), ("timestamp", "<f8", 18)),
        26,
        ("timestamp", float(STAMP_NS), STAMP_NS + SWEEP_S * 1e9),
        ring="line",
    ),
    # Livox's CustomMsg as several converters make a cloud of it.
    "livox converted": Driver(
        (*F4_XYZ, ("intensity", "<f4", 12), ("line", "u1", 16), ("tag", "u1", 17), ("offset_time", "<u4", 20)),
        24,
        ("offset_time", 0.0, SWEEP_S * 1e9),
        ring="line",
    ),
    # nebula (Autoware), PointXYZIRCAEDT.
    "nebula": Driver(
        (
            *F4_XYZ,
            ("intensity", "u1", 12),
            ("return_type", "u1", 13),
            ("channel", "<u2", 14),
            ("azimuth", "<f4", 16),
            ("elevation", "<f4", 20),
            ("distance", "<f4", 24),
            ("time_stamp", "<u4", 28),
        ),
        32,
        ("time_stamp", 0.0, SWEEP_S * 1e9),
        ring="channel",
    ),
    # nebula, PointXYZIRADT (deprecated): seconds since 1970.
    "nebula old": Driver(
        (
            *F4_XYZ,
            ("intensity", "<f4", 16),
            ("ring", "<u2", 20),
            ("azimuth", "<f4", 24),
            ("distance", "<f4", 28),
            ("return_type", "u1", 32),
            ("time_stamp", "<f8", 40),
        ),
        48,
        ("time_stamp", BEGIN_S, BEGIN_S + SWEEP_S),
    ),
    # Like Innoviz and Seyond: solid state, seconds since 1970 in doubles throughout, no ring.
    "solid state": Driver(
        (("x", "<f8", 0), ("y", "<f8", 8), ("z", "<f8", 16), ("timestamp", "<f8", 24), ("intensity", "<u2", 32)),
        40,
        ("timestamp", BEGIN_S, BEGIN_S + SWEEP_S),
        ring=None,
    ),
    # Like Aeva: velocities between, signed nanoseconds about the middle of the frame.
    "fmcw": Driver(
        (*F4_XYZ, ("velocity", "<f4", 12), ("intensity", "<f4", 16), ("time_offset_ns", "<i4", 20)),
        24,
        ("time_offset_ns", -0.5 * SWEEP_S * 1e9, 0.5 * SWEEP_S * 1e9),
        begins_s=-0.5 * SWEEP_S,
        ring=None,
    ),
    # sick_scan_xd, PointXYZRAEI32f with the time of each point.
    "sick": Driver(
        (*F4_XYZ, ("i", "<f4", 12), ("ring", "i1", 16), ("time_offset_nanosec", "<u4", 20),
         ("time_offset_sec", "<f4", 24)),
        28,
        ("time_offset_sec", 0.0, SWEEP_S),
        ring=None,
    ),
    # velodyne_pointcloud of before 2019, and every simulator: no time.
    "no time": Driver((*F4_XYZ, ("intensity", "<f4", 16), ("ring", "<u2", 20)), 32, None),
}  # fmt: skip


def message(driver: Driver, *, big: bool, padding: int) -> bytes:
    """Rows `padding` bytes longer than their points, filled with what is no number."""
    points, width = len(STEPS), len(STEPS) // driver.height
    order = ">" if big else "<"
    rows = np.zeros(
        points,
        np.dtype(
            {
                "names": [name for name, _, _ in driver.fields],
                "formats": [form.replace("<", order) for _, form, _ in driver.fields],
                "offsets": [offset for _, _, offset in driver.fields],
                "itemsize": driver.point_step,
            }
        ),
    )
    for axis, name in enumerate("xyz"):
        rows[name] = 10.0 * axis + STEPS
    for column in {"intensity", driver.ring} & {name for name, _, _ in driver.fields}:
        rows[column] = np.arange(points)
    if driver.times is not None:
        timed, first, last = driver.times
        rows[timed] = first + (last - first) * STEPS
    lines = rows.reshape(driver.height, width)
    data = b"".join(line.tobytes() + b"\xff" * padding for line in lines)
    fields = [(name, offset, CODES[form]) for name, form, offset in driver.fields]
    row_step = width * driver.point_step + padding
    return cloud(fields, data, width, driver.point_step, height=driver.height, row_step=row_step, big=big)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 13])
@pytest.mark.parametrize("name", DRIVERS)
def test_the_clouds_of_every_driver_are_read(name: str, padding: int, big: bool) -> None:
    driver = DRIVERS[name]

    frame = message_decoding.decode(messages.POINT_CLOUD, message(driver, big=big, padding=padding), LimitsConfig())

    assert isinstance(frame, LidarFrame)
    assert frame.xyz_m.dtype == np.float32
    assert frame.xyz_m.flags.c_contiguous
    np.testing.assert_allclose(frame.xyz_m, np.stack([STEPS, 10 + STEPS, 20 + STEPS], axis=1), rtol=1e-6)
    ring = None if driver.ring is None else list(range(len(STEPS)))
    assert (None if frame.ring is None else frame.ring.tolist()) == ring
    if "intensity" in {field for field, _, _ in driver.fields}:
        assert frame.intensity is not None
        assert frame.intensity.tolist() == list(range(len(STEPS)))
    if driver.times is None:
        assert frame.time_offset_s is None
    else:
        assert frame.time_offset_s is not None
        np.testing.assert_allclose(frame.time_offset_s, driver.begins_s + SWEEP_S * STEPS, atol=1e-6)
        assert frame.timed_by.startswith(f"{driver.times[0]}: ")
