"""Stamps of sensors as people read them."""

from __future__ import annotations

from datetime import UTC, datetime

NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000

FIRST_DATE_NS = 946_684_800 * NS_PER_S
"""Start of the year 2000. Stamps before it count from something else, mostly from when a sensor was switched on."""

END_NS = 253_402_300_800 * NS_PER_S
"""End of the year 9999, the last one that ISO 8601 writes with four digits."""


def instant(stamp_ns: int) -> str:
    """UTC to the millisecond, ISO 8601; seconds where the stamp is no date."""
    if not FIRST_DATE_NS <= stamp_ns < END_NS:
        return f"{stamp_ns / NS_PER_S:.3f} s"
    second, beyond = divmod(stamp_ns // NS_PER_MS, 1000)
    return f"{datetime.fromtimestamp(second, UTC):%Y-%m-%dT%H:%M:%S}.{beyond:03d}Z"
