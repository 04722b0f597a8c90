"""Stamps as people read them: in UTC, or in seconds where a stamp is no date."""

from __future__ import annotations

from datetime import UTC, datetime

NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000

FIRST_DATE_NS = 946_684_800 * NS_PER_S
"""Start of the year 2000. Stamps before it count from something else, mostly from when a sensor was switched on."""

END_NS = 253_402_300_800 * NS_PER_S
"""End of the year 9999, the last one that ISO 8601 writes with four digits."""


def instant(stamp_ns: int) -> str:
    """The stamp of a frame, to the millisecond."""
    if not _is_date(stamp_ns):
        return _bare(stamp_ns)
    beyond_ms = stamp_ns // NS_PER_MS % 1000
    return f"{_date(stamp_ns):%Y-%m-%d %H:%M:%S}.{beyond_ms:03d}Z"


def second(stamp_ns: int) -> str:
    """The stamp of an event, to the second."""
    return f"{_date(stamp_ns):%Y-%m-%d %H:%M:%S}Z" if _is_date(stamp_ns) else _bare(stamp_ns)


def day(stamp_ns: int) -> str:
    """The day of a stamp."""
    return f"{_date(stamp_ns):%Y-%m-%d}" if _is_date(stamp_ns) else _bare(stamp_ns)


def _is_date(stamp_ns: int) -> bool:
    return FIRST_DATE_NS <= stamp_ns < END_NS


def _date(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC)


def _bare(stamp_ns: int) -> str:
    return f"{stamp_ns / NS_PER_S:.3f} s"
