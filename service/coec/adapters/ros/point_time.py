"""When each point of a cloud was measured: which field holds the time, in which unit, and counted from when.

`PointCloud2` has no rule for this. Ouster counts nanoseconds from the stamp; Velodyne counts seconds from the stamp or
up to it; Hesai and RoboSense write seconds since 1970, Livox nanoseconds since 1970. So the reading is recognised from
the values: a sweep takes `SHORTEST_S` to `LONGEST_S` and lies within `NEAR_S` of its stamp. Units are a factor of 1000
apart, so that at most one of them makes a usual sweep of a column. If more than one reading is left, the cloud is
refused, and `lidar.time` in the configuration has to say which is right.

Some drivers that write times of day leave the stamp out; then the first point gives it.

Every cloud is judged by itself, so that it reads the same alone and in a stream, live and in a bag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.adapters.frames.incoming import Refusal
from coec.config import PointTimeConfig, TimeBase, TimeUnit
from coec.errors import DecodeError

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

SHORTEST_S: Final = 1e-3
"""Shortest sweep. A shorter one needs no motion compensation: a millisecond at 30 m/s is 3 cm."""

LONGEST_S: Final = 10.0
"""Longest sweep, as the longest period of `config.SweepConfig`."""

NEAR_S: Final = 1.0
"""Most time between a sweep and its stamp: drivers stamp its begin, middle or end, or the instant of sending it."""

SINCE_S: Final = 946_684_800
"""Begin of 2000, seconds since 1970; no time of day is earlier."""

UNTIL_S: Final = 2**31
"""2038, the end of ROS time. As units are a factor of 1000 apart, a value lies between `SINCE_S` and this in at most
one of them."""

FINEST_S: Final = 1e-3
"""Largest step between neighbouring values of a time of day that can date a sweep; float32 is coarser."""

NS_PER_S: Final = 1_000_000_000

_TICKS: Final[dict[TimeUnit, int]] = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": NS_PER_S}
"""Ticks of each unit in a second."""

_UNIT_TEXT: Final[dict[TimeUnit, str]] = {"s": "s", "ms": "ms", "us": "µs", "ns": "ns"}
_BASES: Final[dict[TimeBase, str]] = {"stamp": "since the stamp", "clock": "on the stamp's clock"}


@dataclass(frozen=True, slots=True)
class TimeReading:
    """One way to read a column; with it the first and last point are `begin_s` and `end_s` after the stamp."""

    unit: TimeUnit
    base: TimeBase
    begin_s: float
    end_s: float

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
        said: how to read it, if the configuration says so.

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
    return _after_stamp_s(values, reading, stamp_ns), line


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
    every = [_read(begin, end, unit, base, stamp_ns) for base in bases for unit in units]
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
            f"the times in the field {name} of the points are not near the stamp of their sweep in any unit: do both "
            "come from one clock?",
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


def _as_named(name: str, readings: Sequence[TimeReading]) -> list[TimeReading]:
    """The readings without those on a clock, if the name means the time since the stamp and such a reading is left."""
    since_stamp = [reading for reading in readings if reading.base == "stamp"]
    return since_stamp if since_stamp and name not in ON_A_CLOCK else list(readings)


def _agree(a: TimeReading, b: TimeReading) -> bool:
    return max(abs(a.begin_s - b.begin_s), abs(a.end_s - b.end_s)) < SHORTEST_S


def _read(begin: float, end: float, unit: TimeUnit, base: TimeBase, stamp_ns: int) -> TimeReading:
    whole, rest_s = _stamp(unit, base, stamp_ns)
    ticks = _TICKS[unit]
    return TimeReading(unit, base, (begin - whole) / ticks - rest_s, (end - whole) / ticks - rest_s)


def _stamp(unit: TimeUnit, base: TimeBase, stamp_ns: int) -> tuple[int, float]:
    """What a column counts from: whole seconds, in its unit, and the fraction in seconds. They are separate so that no
    digit of a time of day is lost."""
    if base == "stamp":
        return 0, 0.0
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


def _after_stamp_s(values: NDArray[Any], reading: TimeReading, stamp_ns: int) -> NDArray[np.float32]:
    if reading.base == "stamp" and reading.unit == "s":
        return values.astype(np.float32, copy=False)
    whole, rest_s = _stamp(reading.unit, reading.base, stamp_ns)
    if not whole and not rest_s:
        return (values * (1.0 / _TICKS[reading.unit])).astype(np.float32)
    offset_s = values.astype(np.float64)
    offset_s -= whole
    offset_s *= 1.0 / _TICKS[reading.unit]
    offset_s -= rest_s
    return offset_s.astype(np.float32)
