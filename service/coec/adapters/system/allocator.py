"""Settings of the C library for freed memory. Each function does nothing if the C library has no such setting."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8
"""Parameters of mallopt(3)."""

MAX_ARENAS = 1
"""Number of arenas of the heap. By default there are eight per core, and each keeps the largest frames that its thread
has ever freed: under the load of a vehicle the service grew from 280 to 330 MB within half a minute. With two arenas it
stays at 254 MB, with one at 248 MB, without a difference in processor time or in the round trips of queries."""

LARGE_ALLOCATION_BYTES = 2**20
"""Arrays from this size on get separate maps. By default this limit rises up to 32 MiB as memory is freed, which leaves
holes between the maps of a window: a solve takes 450 MB then, and 370 MB with a fixed limit, in the same time."""

FRAME_ALLOCATION_BYTES = 8 * 2**20
"""Larger than the frames that sensors send repeatedly (clouds of 2 MB, raw images of 6 MB), so that these get memory
that was just freed. If it were mapped anew each time, the system would clear every page first: copying a cloud of 2 MB
then takes 0.8 ms instead of 0.2 ms."""

RETAINED_HEAP_BYTES = 32 * 2**20
"""Free memory that may stay at the end of the heap until `give_back`."""


def limit_arenas() -> None:
    """For a process in which frames pass through many threads. Call it before these threads start."""
    _set_malloc_option(M_ARENA_MAX, MAX_ARENAS)


def return_large_allocations() -> None:
    """For a process that works on large arrays: freed arrays go back to the system at once."""
    _set_malloc_option(M_MMAP_THRESHOLD, LARGE_ALLOCATION_BYTES)


def reuse_frame_memory() -> None:
    """For a process through which frames pass: later frames reuse the memory of earlier ones. Larger memory goes back
    to the system at once, the rest with `give_back`."""
    _set_malloc_option(M_MMAP_THRESHOLD, FRAME_ALLOCATION_BYTES)
    _set_malloc_option(M_TRIM_THRESHOLD, RETAINED_HEAP_BYTES)
    _set_malloc_option(M_TOP_PAD, FRAME_ALLOCATION_BYTES)


def trim_heap() -> None:
    """Give memory that was freed in small pieces, between pieces still in use, back to the system: Zenoh receives in
    pieces of 64 KiB, hundreds for a large message. Takes milliseconds per 100 MB in use."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _set_malloc_option(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)
