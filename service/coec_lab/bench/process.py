"""Processor time and memory of a process, as Linux counts them."""

from __future__ import annotations

import os
from pathlib import Path

BYTES_PER_MB = 1e6
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_CPU_FIELD = 11
"""Index of utime in /proc/PID/stat, counted after the name of the program (proc(5)); stime follows."""

_RESET_PEAK = "5"
"""Written to /proc/PID/clear_refs, resets the peak to the memory that is resident now (proc(5))."""


class ProcessReading:
    """Readings of a process of ours, by its id."""

    def __init__(self, pid: int) -> None:
        self._folder = Path(f"/proc/{pid}")

    @property
    def cpu_s(self) -> float:
        """Processor time of all its threads since it began, s, without other load on the machine."""
        behind_name = (self._folder / "stat").read_text().rpartition(")")[2].split()
        return (int(behind_name[_CPU_FIELD]) + int(behind_name[_CPU_FIELD + 1])) / _TICKS_PER_S

    @property
    def resident_mb(self) -> float:
        """Resident memory (RSS), MB; libraries that other processes share count in full."""
        return self._of("status", "VmRSS")

    @property
    def proportional_mb(self) -> float:
        """Resident memory with every shared page divided by its users (PSS), MB."""
        return self._of("smaps_rollup", "Pss")

    @property
    def peak_mb(self) -> float:
        """Peak resident memory (RSS) since the start or `reset_peak`, MB."""
        return self._of("status", "VmHWM")

    @property
    def children(self) -> list[int]:
        """Ids of the processes that it started."""
        return [
            int(pid) for task in (self._folder / "task").iterdir() for pid in (task / "children").read_text().split()
        ]

    def reset_peak(self) -> None:
        """Reset `peak_mb`."""
        (self._folder / "clear_refs").write_text(_RESET_PEAK)

    def _of(self, file: str, name: str) -> float:
        """An entry of a file in kB, as MB."""
        lines = (self._folder / file).read_text().splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith(f"{name}:"))
        return int(kilobytes) * 1024 / BYTES_PER_MB
