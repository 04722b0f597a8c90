"""Whether the clock of this computer is synchronised."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

TIME_ERROR = 5
"""State of a kernel clock that is not synchronised; adjtimex(2)."""


class _Timex(ctypes.Structure):
    """The beginning of `struct timex`, and room for the rest that the kernel fills."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


@dataclass(frozen=True, slots=True)
class ClockState:
    """What the kernel knows: whether a daemon (NTP, PTP) steers the clock, and the clock's largest error, s."""

    synchronised: bool
    max_error_s: float


def clock_state() -> ClockState | None:
    """The state now; None if the system does not tell."""
    adjtimex = getattr(ctypes.CDLL(None), "adjtimex", None)
    if adjtimex is None:
        return None
    timex = _Timex()
    state = adjtimex(ctypes.byref(timex))  # no mode is set: nothing is adjusted
    return None if state < 0 else ClockState(state != TIME_ERROR, timex.maxerror / 1e6)
