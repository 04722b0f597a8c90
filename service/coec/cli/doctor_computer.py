"""Findings of `coec doctor` on this computer: its disk, its clock, and whether kernels are compiled; and what makes a
finding.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from coec.config import StateConfig
from coec.io.system import clock_state, lock_holder
from coec.schemas.documents import Finding

MIB = 2**20

PROBE_BYTES = 16 * MIB
"""Written to measure the disk, and removed: four camera-LiDAR pairs of full size."""

SLOW_MIB_PER_S = 10.0
"""Three times what an urgent window takes: a pair of 4 MB every 1.2 s."""

CLOCK_LIMIT_S = 1.0
"""Largest error of the clock that the kernel may estimate."""


def ok(check: str, where: str, text: str) -> Finding:
    """A finding that needs no action."""
    return Finding(check=check, level="ok", where=where, text=text)


def warn(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding that should be seen to, although the service can work."""
    return Finding(check=check, level="warn", where=where, text=text, advice=advice)


def fail(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding with which the service cannot do its work."""
    return Finding(check=check, level="fail", where=where, text=text, advice=advice)


def state_findings(state: StateConfig) -> Iterator[Finding]:
    """Whether the state directory exists, belongs to this user, is not in use, and is large and fast enough."""
    folder, where = state.directory, str(state.directory)
    try:
        there = folder.exists()
        above = next(parent for parent in folder.resolve().parents if parent.exists())
    except OSError as error:
        advice = "give the user of the service access to the path, or set another state.directory"
        yield fail("state", where, f"cannot be accessed: {error.strerror}", advice)
        return
    if not there:
        if os.access(above, os.W_OK | os.X_OK):
            yield ok("state", where, "does not exist yet; the service creates it")
        else:
            advice = f"create it and make the user of the service its owner; {above} is not writable for this user"
            yield fail("state", where, "does not exist, and this user cannot create it", advice)
        return
    yield _ownership(folder)
    holder = lock_holder(folder / "lock")
    if holder is not None:
        who = f"process {holder}" if holder else "a process"
        yield ok("lock", where, f"locked by {who}: a service runs here")
    else:
        yield ok("lock", where, "not locked: no service runs here")
    yield from _disk(folder, state.min_free_bytes)


def clock_finding() -> Finding:
    """Whether something synchronises the computer's clock."""
    clock = clock_state()
    if clock is None:
        return warn(
            "clock", "", "the system does not report whether its clock is synchronised", "query its NTP or PTP daemon"
        )
    if not clock.synchronised or clock.max_error_s > CLOCK_LIMIT_S:
        return warn(
            "clock",
            "",
            f"the clock of this computer is not synchronised; its error may be {clock.max_error_s:.1f} s or more",
            "set up PTP, chrony or systemd-timesyncd; stamps of sensors with other clocks are not comparable with it",
        )
    return ok("clock", "", f"synchronised within {1e3 * clock.max_error_s:.1f} ms")


def kernels_finding() -> Finding:
    """Whether the first start has to compile kernels."""
    from numba import config as numba_config

    import coec.geometry.compiler  # noqa: F401  says where the cache is

    folder = Path(numba_config.CACHE_DIR)  # type: ignore[attr-defined]
    compiled = sum(1 for _ in folder.rglob("*.nbi"))
    if compiled:
        return ok("kernels", str(folder), f"{compiled} kernels are compiled, for this user")
    return warn(
        "kernels",
        str(folder),
        "no kernel is compiled for this user: the first start takes a minute or two longer",
        "nothing, or start the service once before the vehicle needs it; its own user has its own cache "
        "($XDG_CACHE_HOME)",
    )


def _ownership(folder: Path) -> Finding:
    where = str(folder)
    try:
        status = folder.stat()
    except OSError as error:
        return fail("state", where, f"cannot be accessed: {error.strerror}", "check its owner and the disk")
    if not stat.S_ISDIR(status.st_mode):
        return fail("state", where, "is not a directory", "set another state.directory")
    if not os.access(folder, os.W_OK | os.X_OK):
        advice = f"make the user of the service its owner (the owner is {status.st_uid}, this is {os.geteuid()})"
        return fail("state", where, "not writable for this user", advice)
    if status.st_uid != os.geteuid():
        text = f"belongs to user {status.st_uid}; this is {os.geteuid()}"
        return warn("state", where, text, "run the doctor as the user of the service to be sure")
    if status.st_mode & stat.S_IWOTH:
        advice = f"chmod o-w {where}: what is read back from there is trusted"
        return warn("state", where, "writable for every user", advice)
    return ok("state", where, "exists and belongs to this user")


def _disk(folder: Path, min_free_bytes: int) -> Iterator[Finding]:
    where = str(folder)
    try:
        status = os.statvfs(folder)
    except OSError as error:
        yield fail("disk", where, f"cannot be queried: {error.strerror}", "check the disk")
        return
    free = status.f_bavail * status.f_frsize
    text = f"{free / MIB:.0f} MiB are free, {min_free_bytes / MIB:.0f} MiB must stay free (state.min_free_bytes)"
    if free < min_free_bytes:
        yield fail("disk", where, f"{text}: no window is recorded", "free space, or lower the limit")
    elif free < 2 * min_free_bytes:
        yield warn("disk", where, text, "free space soon: the oldest windows are deleted first")
    else:
        yield ok("disk", where, text)
    yield _speed(folder)


def _speed(folder: Path) -> Finding:
    where = str(folder)
    data = os.urandom(MIB)
    started_s = time.monotonic()
    try:
        descriptor, name = tempfile.mkstemp(prefix=".doctor-", dir=folder)
        try:
            for at in range(0, PROBE_BYTES, MIB):
                os.pwrite(descriptor, data, at)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
            Path(name).unlink(missing_ok=True)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free space: windows and history cannot be written" if full else "check the disk and its permissions"
        return fail("writing", where, f"cannot be written: {error.strerror}", advice)
    speed = PROBE_BYTES / MIB / max(time.monotonic() - started_s, 1e-6)
    text = f"{speed:.0f} MiB/s, with fsync"
    if speed < SLOW_MIB_PER_S:
        advice = "use a faster disk or smaller frames: pairs that arrive faster than they are written are lost"
        return warn("writing", where, f"slow: {text}", advice)
    return ok("writing", where, text)
