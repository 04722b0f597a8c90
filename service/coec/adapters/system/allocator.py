"""How the C library keeps memory that was freed. Each does nothing where the C library has no such setting."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8
"""Parameters of mallopt(3)."""

ARENAS = 1
"""By default there are eight for each core, and each keeps the largest frames that a thread of its own has ever freed:
under the load of a vehicle the service grew from 280 to 330 MB within half a minute. With two it stays at 254 MB, with
one at 248, and neither the processor time nor the round trips of queries tell the difference."""

LARGE_BYTES = 2**20
"""Arrays from this size on are mapped by themselves. By default the limit rises to 32 MiB with what is freed, and holes
between the maps of a window stay: a solve took 450 MB, and with a fixed limit it takes 370 MB, and no longer."""

FRAME_BYTES = 8 * 2**20
"""What sensors send again and again is smaller, clouds of 2 MB and raw images of 6 MB, and gets memory that was in use
a moment ago. Mapped anew each time, the system clears every page first: a cloud of 2 MB took 0.8 ms to copy, and takes
0.2 ms."""

SPARE_BYTES = 32 * 2**20
"""Free memory at the end of the heap, up to which it stays there until `give_back`."""


def share_arenas() -> None:
    """For a process through which frames pass on many threads. Call before they are started."""
    _set(M_ARENA_MAX, ARENAS)


def return_large() -> None:
    """For a process that works on large arrays: what is freed goes back to the system at once."""
    _set(M_MMAP_THRESHOLD, LARGE_BYTES)


def reuse_frames() -> None:
    """For a process through which frames pass: their memory serves the next ones. What is larger goes back to the
    system at once, the rest with `give_back`."""
    _set(M_MMAP_THRESHOLD, FRAME_BYTES)
    _set(M_TRIM_THRESHOLD, SPARE_BYTES)
    _set(M_TOP_PAD, FRAME_BYTES)


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
