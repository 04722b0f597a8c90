"""How the C library keeps memory that was freed. Each does nothing where the C library has no such setting."""

from __future__ import annotations

import ctypes

M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8
"""Parameters of mallopt(3)."""

ARENAS = 1
"""By default there are eight for each core, and each keeps the largest frames that a thread of its own has ever freed:
under the load of a vehicle the service grew from 280 to 330 MB within half a minute. With two it stays at 254 MB, with
one at 248, and neither the processor time nor the round trips of queries tell the difference."""

LARGE_BYTES = 2**20
"""Arrays from this size on are mapped by themselves. By default the limit rises to 32 MiB with what is freed, and holes
between the maps of a window stay: a solve took 450 MB, and with a fixed limit it takes 370 MB, and no longer."""


def share_arenas() -> None:
    """For a process through which frames pass on many threads. Call before they are started."""
    _set(M_ARENA_MAX, ARENAS)


def return_large() -> None:
    """For a process that works on large arrays, or takes what others send: what is freed goes back to the system at
    once."""
    _set(M_MMAP_THRESHOLD, LARGE_BYTES)


def give_back() -> None:
    """What was freed in small pieces, and lies between what is still used, goes back to the system: Zenoh receives in
    pieces of 64 KiB, of which a large message takes hundreds. Takes milliseconds for each 100 MB in use."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _set(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)
