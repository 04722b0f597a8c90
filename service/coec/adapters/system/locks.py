"""Which process holds a lock on a file. It is found without taking the lock, so that a process that starts meanwhile
does not find it taken."""

from __future__ import annotations

import os
from pathlib import Path


def lock_holder(path: Path) -> int | None:
    """Id of a process that holds flock(2) on a file; None if none does, or if the system does not tell; 0 for a process
    that this one cannot see."""
    try:
        status, lines = path.stat(), Path("/proc/locks").read_text().splitlines()
    except OSError:
        return None
    file = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    for line in lines:
        columns = line.split()
        if len(columns) >= 6 and columns[1] == "FLOCK" and columns[5] == file:
            return int(columns[4])
    return None
