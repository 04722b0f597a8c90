"""Converts `sensor_msgs/PointCloud2` to sweeps and back, with any order of fields, padding and organisation, and one
copy per column; when each point was measured (field, unit and base of its time); the points of one LiDAR in a
concatenated cloud; and Livox's own message as a `PointCloud2`.

`PointCloud2` has no rule for this. Ouster counts nanoseconds from the stamp; Velodyne counts seconds from the stamp or
up to it; Hesai and RoboSense write seconds since 1970, Livox nanoseconds since 1970. So the reading is recognised from
the values: a sweep takes `SHORTEST_S` to `LONGEST_S` and lies within `NEAR_S` of its stamp. Units are a factor of 1000
apart, so that at most one of them makes a usual sweep of a column. If more than one reading is left, the cloud is
refused, and `lidar.time` in the configuration has to say which is right.

Some drivers that write times of day leave the stamp out; then the first point gives it.

Every cloud is judged by itself, so that it reads the same alone and in a stream, live and in a bag.

Most programs that join clouds write no such field. Autoware's `concatenate_data` puts the sources into another message
(`ConcatenatedPointCloudInfo`), and no field of its points (x, y, z, intensity, return_type, channel, azimuth,
elevation, distance, time_stamp) holds them. A `laser_id` or `channel` is the number of a beam, not of a LiDAR.
"""

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros
from rosbags.typesys.stores.ros2_humble import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointField as PointField
from rosbags.typesys.stores.ros2_humble import std_msgs__msg__Header as Header

from coec.calibration.types import NS_PER_S, LidarFrame, Recognition
from coec.config import LimitsConfig, PointTimeConfig, TimeBase, TimeUnit
from coec.errors import DecodeError
from coec.io.frame_validation import MAX_FRAME_ID, Refusal, finite_rows, lidar_frame
from coec.io.ros.messages import check_header

FIELDS: Final = (
    "t",
    "time",
    "time_offset",
    "offset_time",
    "timestamp",
    "time_stamp",
    "time_offset_ns",
    "time_offset_sec",
)
"""Names that drivers use for the time field; the first that a cloud has counts. Ouster `t`, Velodyne `time`, Livox
`offset_time` and `timestamp`, Hesai and RoboSense `timestamp`, Autoware `time_stamp`, Aeva `time_offset_ns`, SICK
`time_offset_sec`."""

ON_A_CLOCK: Final = ("timestamp", "time_stamp")
"""Names that drivers use both for the time of day and for the time since the stamp."""

REFLECTANCE_FIELDS: Final = ("intensity", "reflectivity", "reflectance")
"""Names that drivers use for how much light comes back; the first that a cloud has counts."""

RING_FIELDS: Final = ("ring", "channel", "line")
"""Names that drivers use for the number of the scan line, likewise."""

OTHERWISE_READ: Final = ("x", "y", "z", *REFLECTANCE_FIELDS, *RING_FIELDS, "rgb", "rgba")
"""Names of fields that are no times."""

LIKE_A_TIME: Final = re.compile(r"(?i:time|stamp|(^|_)(t|ts|dt|n?sec|[mnu]s|[mu]sec)(_|$))|[a-z]T($|[A-Z_])")
"""Names that mean a time, in other drivers: Blickfeld `point_time_offset`, and whatever people think of."""

FEWEST_STEPS: Final = 100
"""Fewer points show no order."""

RESET, FALLING = 0.5, 0.02
"""A time rises from point to point in the order in which points are stored. Where rows or returns are stored one after
the other, it falls by more than the first share of the sweep; of the other steps, at most the second share fall."""

SHORTEST_S: Final = 1e-3
"""Shortest sweep. A shorter one needs no motion compensation: a millisecond at 30 m/s is 3 cm."""

LONGEST_S: Final = 10.0
"""Longest sweep, as the longest period of `config.SweepConfig`."""

DIFFERENT_S: Final = 5e-3
"""Two fields that time a point so differently contradict each other: 5 cm at 10 m/s."""

NEAR_S: Final = 1.0
"""Most time between a sweep and its stamp: drivers stamp its begin, middle or end, or the instant of sending it."""

SINCE_S: Final = 946_684_800
"""Begin of 2000, seconds since 1970; no time of day is earlier."""

UNTIL_S: Final = 2**31
"""2038, the end of ROS time. As units are a factor of 1000 apart, a value lies between `SINCE_S` and this in at most
one of them."""

FINEST_S: Final = 1e-3
"""Largest step between neighbouring values of a time of day that can date a sweep; float32 is coarser."""

_TICKS: Final[dict[TimeUnit, int]] = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": NS_PER_S}
"""Ticks of each unit in a second."""

_UNIT_TEXT: Final[dict[TimeUnit, str]] = {"s": "s", "ms": "ms", "us": "µs", "ns": "ns"}
_BASES: Final[dict[TimeBase, str]] = {
    "stamp": "since the stamp",
    "clock": "on the stamp's clock",
    "begin": "on another clock, begins at the stamp",
    "end": "on another clock, ends at the stamp",
}


@dataclass(frozen=True, slots=True)
class TimeReading:
    """One way to read a column; with it the first and last point are `begin_s` and `end_s` after the stamp, which the
    column counts as `whole` of its units and `rest_s` seconds."""

    unit: TimeUnit
    base: TimeBase
    begin_s: float
    end_s: float
    whole: float = 0
    rest_s: float = 0.0

    @property
    def lasts_s(self) -> float:
        """The duration of the sweep."""
        return self.end_s - self.begin_s

    @property
    def sentence(self) -> str:
        """The reading in words, without the name of the field."""
        begin, end = (f"{1e3 * value:.1f}".replace("-0.0", "0.0") for value in (self.begin_s, self.end_s))
        since = " from the stamp" if self.base == "clock" else ""
        return f"{_UNIT_TEXT[self.unit]} {_BASES[self.base]}; {begin} to {end} ms{since}"

    @property
    def stamped(self) -> str:
        """Where in the sweep the stamp lies, to a tenth of the sweep; empty if at none of the usual places."""
        tenth = 0.1 * self.lasts_s
        if self.lasts_s < SHORTEST_S:
            return ""
        if abs(self.begin_s) <= tenth:
            return ", stamped at its begin"
        if abs(self.end_s) <= tenth:
            return ", stamped at its end"
        return ", stamped in its middle" if abs(self.begin_s + self.end_s) <= 2 * tenth else ""


def offsets_s(
    name: str,
    column: NDArray[Any],
    keep: NDArray[np.bool_] | None,
    stamp_ns: int,
    configured: PointTimeConfig | None,
) -> tuple[NDArray[np.float32], str]:
    """(N,) float32 seconds after the stamp at which each point was measured, and a line that says how they were read.

    Args:
        name: of the field.
        column: (N,) its values.
        keep: (N,) the points whose values count, None: all; other values may be anything.
        configured: how to read it, if the configuration says so.

    Raises:
        DecodeError: `cloud_time` if no reading brings the points near the stamp, `cloud_time_ambiguous` if several do.
    """
    values = np.ascontiguousarray(column, column.dtype.newbyteorder("="))
    begin, end = _range(values if keep is None else values[keep])
    if configured is not None:
        reading = _read(begin, end, configured.unit, configured.base, stamp_ns)
    else:
        reading = recognised(name, values.dtype, begin, end, stamp_ns)
    line = f"{name}: {values.dtype.name}, {reading.sentence}{reading.stamped}"
    return _after_stamp_s(values, reading), line


def time_field(columns: Mapping[str, NDArray[Any]], keep: NDArray[np.bool_] | None, stamp_ns: int) -> str | None:
    """The first of `FIELDS` in some columns that holds the time of the points; None without any. One that is equal for
    all points, or cannot be a time, counts only if all are so. Arguments as for `offsets_s`.

    Raises:
        DecodeError: `cloud_time_ambiguous`: two of them give different times.
    """
    names = [name for name in FIELDS if name in columns]
    if len(names) < 2 or not stamp_ns:
        return names[0] if names else None
    read: dict[str, tuple[NDArray[np.float32], str]] = {}
    for name in names:
        values = columns[name] if keep is None else columns[name][keep]
        if not np.ptp(_range(values)):
            continue
        try:
            offset_s, line = offsets_s(name, values, None, stamp_ns, None)
        except DecodeError as error:
            if error.reason != Refusal.CLOUD_TIME:
                raise
            continue
        if np.ptp(offset_s) >= SHORTEST_S:
            read[name] = offset_s, line
    first = next(iter(read), names[0])
    for other_s, other in list(read.values())[1:]:
        if np.abs(read[first][0] - other_s).max() > DIFFERENT_S:
            text = f"the points have two times that contradict each other, {read[first][1]}; and {other}"
            way = "say which with ?time=FIELD,UNIT,BASE of a bag (`lidar.time` live)"
            raise DecodeError(Refusal.CLOUD_TIME_AMBIGUOUS, f"{text}: {way}")
    return first


def stamp_in(column: NDArray[Any], keep: NDArray[np.bool_] | None, configured: PointTimeConfig | None) -> int | None:
    """The time of the first point, ns, for a cloud without a stamp; None if its points have no time of day, or not the
    one in the configuration. Arguments as for `offsets_s`."""
    values = np.ascontiguousarray(column, column.dtype.newbyteorder("="))
    begin, end = _range(values if keep is None else values[keep])
    clocked = [unit for unit in _TICKS if configured is None or (configured.unit, configured.base) == (unit, "clock")]
    since_s = SINCE_S if configured is None else 0
    for unit in clocked:
        ticks = _TICKS[unit]
        finest = 1.0 if values.dtype.kind != "f" else float(np.spacing(values.dtype.type(begin)))
        if since_s < begin / ticks and end / ticks < UNTIL_S and finest / ticks <= FINEST_S:
            seconds, rest = divmod(begin, ticks)
            return int(seconds) * NS_PER_S + round(rest * (NS_PER_S / ticks))
    return None


def recognised(name: str, dtype: np.dtype[Any], begin: float, end: float, stamp_ns: int) -> TimeReading:
    """How to read a column whose values reach from `begin` to `end`.

    Raises:
        DecodeError: `cloud_time`, `cloud_time_ambiguous`.
    """
    counts = dtype.kind != "f"
    units: tuple[TimeUnit, ...] = ("ns", "us", "ms", "s") if counts else ("s", "ms", "us", "ns")
    bases: tuple[TimeBase, ...] = ("stamp", "clock")
    step = 0.0 if counts else float(np.spacing(dtype.type(max(abs(begin), abs(end)))))
    read = (_read(begin, end, unit, base, stamp_ns) for base in bases for unit in units)
    every = [one for one in read if one.base != "clock" or step / _TICKS[one.unit] <= FINEST_S]
    near = [reading for reading in every if reading.begin_s <= NEAR_S and reading.end_s >= -NEAR_S]
    sweeps = _as_named(name, [reading for reading in near if SHORTEST_S <= reading.lasts_s <= LONGEST_S])
    instants = _as_named(name, [reading for reading in near if reading.lasts_s < SHORTEST_S])
    # Few drivers write whole milliseconds, so that such values may also be nanoseconds of a flash LiDAR.
    flashes = [reading for reading in instants if counts and reading.unit == "ns" and reading.base == "stamp"]
    coarse = any(reading.unit in ("ms", "s") for reading in sweeps)
    candidates = [*sweeps, *(flashes if coarse else ())] if sweeps else instants
    if not candidates:
        raise DecodeError(
            Refusal.CLOUD_TIME,
            f"the times in the field {name} of the points are not near the stamp of their sweep in any unit: "
            f"{_other_clock(name, step, begin, end, units, stamp_ns)}",
        )
    first = candidates[0]
    if all(_agree(first, other) for other in candidates):
        return first
    readings_text = "; or ".join(reading.sentence for reading in candidates)
    raise DecodeError(
        Refusal.CLOUD_TIME_AMBIGUOUS,
        f"the field {name} of the points may be {readings_text}: say which with "
        f"`lidar.time: {{field: {name}, unit: {first.unit}, base: {first.base}}}`, of a bag with "
        f"`?time={name},{first.unit},{first.base}`",
    )


def _other_clock(name: str, step: float, begin: float, end: float, units: Sequence[TimeUnit], stamp_ns: int) -> str:
    """What times may be that are not near the stamp, and what to type. `step`: between neighbouring numbers."""
    if step > 1.0:
        return (
            f"as large as these, such numbers come in steps of {step:g}, too coarse for a clock: let the driver write "
            "float64, or times since the stamp"
        )
    for reading in (_read(begin, end, unit, "clock", stamp_ns) for unit in reversed(units)):
        if SHORTEST_S <= reading.lasts_s <= 0.1 * LONGEST_S and abs(reading.begin_s) > NEAR_S:
            begins, ends = (f"{name},{reading.unit},{base}" for base in ("begin", "end"))
            return (
                f"in {_UNIT_TEXT[reading.unit]} they last {1e3 * reading.lasts_s:.1f} ms, and begin "
                f"{abs(reading.begin_s):.3f} s {'before' if reading.begin_s < 0 else 'after'} the stamp, so they are "
                "of another clock: let the driver stamp with the clock of the points; or, if the stamp is that of the "
                f"first point, say `?time={begins}`, if of the last one, `?time={ends}` (`lidar.time` live)"
            )
    return "do both come from one clock?"


def _as_named(name: str, readings: Sequence[TimeReading]) -> list[TimeReading]:
    """The readings without those on a clock, if the name means the time since the stamp and such a reading is left."""
    since_stamp = [reading for reading in readings if reading.base == "stamp"]
    return since_stamp if since_stamp and name not in ON_A_CLOCK else list(readings)


def _agree(a: TimeReading, b: TimeReading) -> bool:
    return max(abs(a.begin_s - b.begin_s), abs(a.end_s - b.end_s)) < SHORTEST_S


def _read(begin: float, end: float, unit: TimeUnit, base: TimeBase, stamp_ns: int) -> TimeReading:
    whole, rest_s = _stamp(begin, end, unit, base, stamp_ns)
    ticks = _TICKS[unit]
    return TimeReading(unit, base, (begin - whole) / ticks - rest_s, (end - whole) / ticks - rest_s, whole, rest_s)


def _stamp(begin: float, end: float, unit: TimeUnit, base: TimeBase, stamp_ns: int) -> tuple[float, float]:
    """What a column from `begin` to `end` counts from: whole seconds, in its unit, and the fraction in seconds. They
    are separate so that no digit of a time of day is lost."""
    if base == "stamp":
        return 0, 0.0
    if base != "clock":
        return begin if base == "begin" else end, 0.0
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    return seconds * _TICKS[unit], nanoseconds * 1e-9


def _range(values: NDArray[Any]) -> tuple[float, float]:
    """Least and largest finite value; (0, 0) if there is none."""
    if values.size == 0:
        return 0.0, 0.0
    least, most = values.min().item(), values.max().item()
    if np.isfinite(least) and np.isfinite(most):
        return least, most
    return _range(values[np.isfinite(values)])


def _after_stamp_s(values: NDArray[Any], reading: TimeReading) -> NDArray[np.float32]:
    if reading.base == "stamp" and reading.unit == "s":
        return values.astype(np.float32, copy=False)
    if not reading.whole and not reading.rest_s:
        return (values * (1.0 / _TICKS[reading.unit])).astype(np.float32)
    offset_s = values.astype(np.float64)
    offset_s -= reading.whole
    offset_s *= 1.0 / _TICKS[reading.unit]
    offset_s -= reading.rest_s
    return offset_s.astype(np.float32)


SOURCE_FIELDS: Final = ("lidar_id", "sensor_id", "source_id", "device_id", "source")
"""Names of integer fields in which joined clouds identify the LiDAR: `lidar_id`, `sensor_id` and `source` in published
projects, `device_id` in Kitware's SLAM (beside its `laser_id`, the beam)."""

_WIDTHS: Final = {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
}

MAX_LISTED: Final = 16
"""Most sources that a refusal lists. A vehicle has fewer LiDARs, but the field may hold other numbers, however many."""


def points_of_source(message: PointCloud2, source: int | None) -> PointCloud2:
    """The points of one LiDAR, in their order, as a cloud of one row; the message unchanged if it holds no others.

    Args:
        message: its data must be as long as its layout says.
        source: number of the requested LiDAR; None: the cloud must hold only one.

    Raises:
        DecodeError: `cloud_concatenated`: several sources but none requested, or no point of the requested one; lists
            the sources.
    """
    field = next((field for name in SOURCE_FIELDS for field in message.fields if field.name == name), None)
    values = None if field is None else _values(message, field)
    if field is None or values is None:
        if source is None:
            return message
        raise DecodeError(
            Refusal.CLOUD_CONCATENATED,
            f"source {source} is asked for, but no field of the points names one: {', '.join(SOURCE_FIELDS)} would",
        )
    selected = int(values[0, 0]) if source is None else source
    mine = values == selected
    if mine.all():
        return message
    if source is None or not mine.any():
        known = np.unique(values)
        listed = ", ".join(map(str, known[:MAX_LISTED].tolist())) + (", ..." if len(known) > MAX_LISTED else "")
        advice = "choose one" if source is None else f"none has {source}"
        raise DecodeError(
            Refusal.CLOUD_CONCATENATED, f"the cloud is concatenated: its {field.name} has {listed}; {advice}"
        )
    rows = _rows(message)[mine]
    return replace(
        message,
        height=1,
        width=len(rows),
        row_step=len(rows) * message.point_step,
        data=np.ascontiguousarray(rows).reshape(-1),
    )


def _values(message: PointCloud2, field: PointField) -> NDArray[np.integer] | None:
    """(height, width) numbers of a field; None if it holds no integers or lies outside of its point."""
    width = _WIDTHS.get(field.datatype)
    if width is None or field.offset + int(width[1]) > message.point_step:
        return None
    return np.ndarray(
        shape=(message.height, message.width),
        dtype=np.dtype(width).newbyteorder(">" if message.is_bigendian else "<"),
        buffer=message.data,
        offset=field.offset,
        strides=(message.row_step, message.point_step),
    )


def _rows(message: PointCloud2) -> NDArray[np.uint8]:
    """(height, width, point_step) bytes of the points."""
    return np.ndarray(
        shape=(message.height, message.width, message.point_step),
        dtype=np.uint8,
        buffer=message.data,
        strides=(message.row_step, message.point_step, 1),
    )


_DTYPES: dict[int, np.dtype[Any]] = {
    PointField.INT8: np.dtype("i1"),
    PointField.UINT8: np.dtype("u1"),
    PointField.INT16: np.dtype("<i2"),
    PointField.UINT16: np.dtype("<u2"),
    PointField.INT32: np.dtype("<i4"),
    PointField.UINT32: np.dtype("<u4"),
    PointField.FLOAT32: np.dtype("<f4"),
    PointField.FLOAT64: np.dtype("<f8"),
}

_XYZ_BYTES = np.dtype("V12")
"""x y z as float32."""


def frame_of(
    message: PointCloud2,
    stamp_ns: int,
    limits: LimitsConfig,
    *,
    point_time: PointTimeConfig | None = None,
    source: int | None = None,
) -> LidarFrame:
    """The sweep of a message whose header is already checked.

    `x y z` may be float32 or float64; intensity, of `REFLECTANCE_FIELDS`, any number; ring, of `RING_FIELDS`, an
    unsigned integer. The time is one of `FIELDS`, any number, read as recognised in `point_time` or as the argument
    `point_time` says. Optional fields of other types are left out, and so are fields with several values per point. A
    `stamp_ns` of 0 means no stamp; then the first point gives it, if it has a time of day. `source`: see
    `points_of_source`.

    Raises:
        DecodeError: `cloud_shape`, `cloud_fields`, `cloud_too_large`, `cloud_empty`, `cloud_time`,
        `cloud_time_ambiguous`, `cloud_concatenated`.
    """
    message = points_of_source(_checked_layout(message, limits), source)
    by_name = {field.name: field for field in reversed(message.fields)}  # the first field of a name counts
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 become infinite and are dropped
        xyz_m = _positions(message, by_name)
        intensity = _column(message, next((by_name[n] for n in REFLECTANCE_FIELDS if n in by_name), None), "fiu")
        ring = _column(message, next((by_name[n] for n in RING_FIELDS if n in by_name), None), "u")
        if ring is not None and ring.itemsize > 2 and int(ring.max()) > 0xFFFF:
            raise DecodeError(Refusal.CLOUD_FIELDS, "a ring number exceeds 65535")
        times = _times(message, by_name, finite_rows(xyz_m), stamp_ns, point_time)
        frame = lidar_frame(
            times.stamp_ns,
            message.header.frame_id,
            xyz_m,
            None if intensity is None else intensity.astype(np.float32),
            None if ring is None else ring.astype(np.uint16),
            times.offset_s,
            timed_by=times.description,
        )
        return replace(frame, recognitions=times.recognitions) if times.recognitions else frame


WRITTEN_TIME: Final = PointTimeConfig(field="time", unit="s", base="stamp")
"""How `message_of` writes the times of points, as Velodyne does."""


def message_of(frame: LidarFrame) -> PointCloud2:
    """The message that `frame_of` reads back to an equal sweep; without padding, with points timed as
    `WRITTEN_TIME`."""
    given = [
        ("x", frame.xyz_m[:, 0], PointField.FLOAT32),
        ("y", frame.xyz_m[:, 1], PointField.FLOAT32),
        ("z", frame.xyz_m[:, 2], PointField.FLOAT32),
        ("intensity", frame.intensity, PointField.FLOAT32),
        ("ring", frame.ring, PointField.UINT16),
        (WRITTEN_TIME.field, frame.time_offset_s, PointField.FLOAT32),
    ]
    columns = [(name, values, datatype) for name, values, datatype in given if values is not None]
    rows = np.empty(len(frame.xyz_m), np.dtype([(name, _DTYPES[datatype]) for name, _, datatype in columns]))
    fields = []
    offset = 0
    for name, values, datatype in columns:
        rows[name] = values
        fields.append(PointField(name, offset, datatype, 1))
        offset += _DTYPES[datatype].itemsize
    seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
    return PointCloud2(
        header=Header(Time(seconds, nanoseconds), frame.frame_id),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=offset,
        row_step=offset * len(rows),
        data=rows.view(np.uint8),
        is_dense=True,
    )


def row_step_of(message: PointCloud2) -> int:
    """Bytes from row to row. Drivers of one row leave `row_step` out, and others state the whole cloud there: where it
    does not fit, and the data is as long as rows without padding, these are assumed."""
    row = message.width * message.point_step
    fits = row <= message.row_step <= (message.data.size - row) // max(message.height - 1, 1)
    return row if message.height == 1 or (not fits and message.data.size == message.height * row) else message.row_step


def _checked_layout(message: PointCloud2, limits: LimitsConfig) -> PointCloud2:
    """The message with its `row_step`, whose sizes are checked in Python integers, which do not overflow."""
    count = message.width * message.height
    if count > limits.max_points:
        raise DecodeError(Refusal.CLOUD_TOO_LARGE, f"{count} points; limits.max_points is {limits.max_points}")
    if count == 0:
        raise DecodeError(Refusal.CLOUD_EMPTY, "the cloud has no point")
    row_step = row_step_of(message)
    if (
        message.point_step == 0
        or row_step < message.width * message.point_step
        or message.data.size < (message.height - 1) * row_step + message.width * message.point_step
    ):
        raise DecodeError(
            Refusal.CLOUD_SHAPE,
            f"{message.height}×{message.width} points of {message.point_step} bytes, rows {message.row_step} apart, "
            f"do not fit into {message.data.size} bytes",
        )
    return message if row_step == message.row_step else replace(message, row_step=row_step)


def _positions(message: PointCloud2, by_name: Mapping[str, PointField]) -> NDArray[np.float32]:
    """(N, 3) x y z."""
    together = _contiguous_positions(message, by_name)
    if together is not None:
        return together
    xyz_m = np.empty((message.width * message.height, 3), np.float32)
    for i, axis in enumerate("xyz"):
        column = _column(message, by_name.get(axis), "f")
        if column is None:
            raise DecodeError(Refusal.CLOUD_FIELDS, "the cloud needs the fields x, y, z as float32 or float64")
        xyz_m[:, i] = column
    return xyz_m


def _contiguous_positions(message: PointCloud2, by_name: Mapping[str, PointField]) -> NDArray[np.float32] | None:
    """x y z in the layout of most drivers, float32 one after the other. Copying the three together takes a third of the
    time of single columns. None for any other layout."""
    x = by_name.get("x")
    if x is None or x.offset + _XYZ_BYTES.itemsize > message.point_step:
        return None
    for i, axis in enumerate("xyz"):
        field = by_name.get(axis)
        if field is None or (field.datatype, field.offset) != (PointField.FLOAT32, x.offset + 4 * i) or field.count > 1:
            return None
    places = np.ascontiguousarray(_view(message, _XYZ_BYTES, x.offset))
    return places.view(">f4" if message.is_bigendian else "<f4").reshape(-1, 3).astype(np.float32, copy=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Times:
    """The stamp of a sweep, the times of its points, and how they were read.

    Attributes:
        stamp_ns: that of the header; if it has none, that of the first point, if points have a time of day.
        offset_s: (N,) seconds after the stamp; None if no field holds a time.
        description: see `LidarFrame.timed_by`.
        recognitions: see `LidarFrame`.
    """

    stamp_ns: int
    offset_s: NDArray[np.float32] | None
    description: str
    recognitions: tuple[Recognition, ...] = ()


def _times(
    message: PointCloud2,
    by_name: Mapping[str, PointField],
    keep: NDArray[np.bool_] | None,
    stamp_ns: int,
    configured: PointTimeConfig | None,
) -> _Times:
    """`keep` as in `offsets_s`."""
    names = FIELDS if configured is None else (configured.field,)
    there = {name: _column(message, by_name[name], "fiu") for name in names if name in by_name}
    columns = {name: column for name, column in there.items() if column is not None}
    name = next(iter(columns), None) if configured is not None else time_field(columns, keep, stamp_ns)
    column = None if name is None else columns[name]
    recognitions: tuple[Recognition, ...] = ()
    if not there and configured is None:
        name, column, recognitions = _unknown_time(message, by_name, keep, stamp_ns)
    if name is None or column is None:
        return _Times(stamp_ns, None, "", recognitions)
    first_ns = None if stamp_ns else stamp_in(column, keep, configured)
    offset_s, description = offsets_s(name, column, keep, first_ns or stamp_ns, configured)
    if configured is None and len(offset_s) > 1 and float(np.ptp(offset_s)) < SHORTEST_S:
        recognitions = (*recognitions, ONE_TIME)
    if first_ns is None:
        return _Times(stamp_ns, offset_s, description, recognitions)
    description = f"{description}; without a stamp, that of the first point is taken"
    return _Times(first_ns, offset_s, description, recognitions)


ONE_TIME: Final = Recognition(
    "one_point_time",
    "All points of a cloud have one time. That is right for a flash LiDAR; otherwise the driver does not time its "
    "points, and clouds taken while driving stay distorted: let the driver time each point, or record slowly.",
    level="warn",
)


def _unknown_time(
    message: PointCloud2, by_name: Mapping[str, PointField], keep: NDArray[np.bool_] | None, stamp_ns: int
) -> tuple[str | None, NDArray[Any] | None, tuple[Recognition, ...]]:
    """The field that is the time of the points although no driver that is known calls it so, its column, and what to
    tell. A field that rises through the cloud and could be a time counts as one if its values lie on the clock of the
    stamp, which chance does not bring about, or if its name means a time and the stamp lies at its begin, middle or
    end; counters, and fractions of a second, rise, too, so that any other is only named."""
    times: list[tuple[str, NDArray[Any], TimeReading]] = []
    doubts: list[str] = []
    for name, field in by_name.items():
        column = None if name in OTHERWISE_READ or not name.isprintable() else _column(message, field, "fiu")
        values = None if column is None else (column if keep is None else column[keep])
        if column is None or values is None or not stamp_ns or not _rises(values):
            continue
        try:
            reading = recognised(name, column.dtype, *_range(values), stamp_ns)
        except DecodeError as error:
            doubts += [str(error)] if LIKE_A_TIME.search(name) else []
            continue
        if reading.lasts_s < SHORTEST_S:
            continue
        if reading.base == "clock" or (LIKE_A_TIME.search(name) and reading.stamped):
            times.append((name, column, reading))
        else:
            way = f"`?time={name},{reading.unit},{reading.base}` (`lidar.time` live)"
            doubts.append(f"`{name}` rises from point to point: if it is a time, and no counter, say {way}")
    if not times:
        text = f"No field of the points is known as their time, but {'; '.join(doubts)}."
        return None, None, (Recognition("perhaps_a_time", text, level="warn"),) if doubts else ()
    name, column, reading = min(times, key=lambda one: one[2].base != "clock")
    text = (
        f"The field `{name}` is read as the time of the points, because it rises from point to point "
        f"({reading.sentence}). If it is none, name the right one with `?time=FIELD,UNIT,BASE` (`lidar.time` live)."
    )
    return name, column, (Recognition("time_by_values", text),)


def _rises(values: NDArray[Any]) -> bool:
    """Whether a column rises in the order in which points are stored, in one pass or a few."""
    steps = np.diff(values.astype(np.float64))
    if len(steps) < FEWEST_STEPS or not np.isfinite(steps).all():
        return False
    span = float(np.ptp(values.astype(np.float64)))
    small = steps[np.abs(steps) <= RESET * span]
    return bool(span > 0.0 and len(small) >= 0.5 * len(steps) and (small < 0.0).sum() <= FALLING * (small != 0.0).sum())


def _column(message: PointCloud2, field: PointField | None, kinds: str) -> NDArray[Any] | None:
    """(N,) values of a field; None if it is absent or not of these NumPy kinds."""
    if field is None or field.datatype not in _DTYPES or _DTYPES[field.datatype].kind not in kinds:
        return None
    if field.count > 1:  # some drivers write 0 for 1
        return None
    dtype = _DTYPES[field.datatype].newbyteorder(">" if message.is_bigendian else "<")
    if field.offset + dtype.itemsize > message.point_step:
        raise DecodeError(Refusal.CLOUD_SHAPE, "a field lies outside its point")
    return _view(message, dtype, field.offset).reshape(-1)


def _view(message: PointCloud2, dtype: np.dtype[Any], offset: int) -> NDArray[Any]:
    """(height, width) values at an offset in each point; the caller has checked that they fit."""
    return np.ndarray(
        shape=(message.height, message.width),
        dtype=dtype,
        buffer=message.data,
        offset=offset,
        strides=(message.row_step, message.point_step),
    )


# --- Livox's own message ----------------------------------------------------------------------------------------------

TYPES: Final = (
    "livox_ros_driver2/msg/CustomMsg",
    "livox_ros_driver/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)

_POINT: Final = 19
"""Bytes of a point."""

_FIXED: Final = struct.Struct("<QI4xI")
"""Time base, number of points, LiDAR and reserved bytes, and the length of the list."""

_FIELDS: Final = (("offset_time", 0, 6), ("x", 4, 7), ("y", 8, 7), ("z", 12, 7), ("intensity", 16, 2), ("line", 18, 2))
"""Name, offset and `PointField.datatype` of what is read; `tag` says how noisy a return is."""


def cloud_of_cdr(payload: bytes) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message in CDR, little endian.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid` or `cloud_empty`.
    """
    check_header(payload)
    if payload[1] != 1:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "a cloud of Livox in big-endian CDR is not read")
    return _cloud(payload, 4, 4, _POINT + 1)


def cloud_of_ros_1(data: bytes) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message of ROS 1, whose header begins with a sequence number.

    Raises:
        DecodeError: as above.
    """
    return _cloud(data, 4, 1, _POINT)


def _cloud(data: bytes, at: int, alignment: int, stride: int) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message whose stamp stands at `at`, and whose values are aligned to as many bytes behind it."""
    try:
        seconds, nanoseconds, length = struct.unpack_from("<iII", data, at)
        frame = data[at + 12 : at + 12 + length]
        if length > 4 * MAX_FRAME_ID + 1 or len(frame) != length:
            raise DecodeError(Refusal.FRAME_ID_INVALID, "the frame id is too long, or cut off")
        end = at + 12 + length
        begin = end + (-(end - at) % (2 * alignment) if alignment > 1 else 0)
        _, _, count = _FIXED.unpack_from(data, begin)
    except struct.error as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head") from error
    begin += _FIXED.size
    # The last point is not padded.
    size = count * stride - (stride - _POINT)
    if count == 0:
        raise DecodeError(Refusal.CLOUD_EMPTY, "the cloud has no point")
    if size > len(data) - begin:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, f"{count} points of {stride} bytes do not fit into the message")
    stamp = ros.builtin_interfaces__msg__Time(seconds, nanoseconds)
    header = ros.std_msgs__msg__Header(stamp, frame.rstrip(b"\0").decode(errors="replace"))
    points = np.frombuffer(data[begin : begin + size] + bytes(stride - _POINT), np.uint8)
    fields = [ros.sensor_msgs__msg__PointField(name, offset, kind, 1) for name, offset, kind in _FIELDS]
    return ros.sensor_msgs__msg__PointCloud2(header, 1, count, fields, False, stride, count * stride, points, True)
