"""How much processor time a process has taken."""

from __future__ import annotations

import time


def processor_time_s(pid: int) -> float:
    """Processor time of all threads of a process since it began, s, to the microsecond.

    Raises:
        OSError: the process is gone.
    """
    # The clock of a process: the complement of its id, and CPUCLOCK_SCHED (clock_getcpuclockid(3), Linux).
    return time.clock_gettime((~pid << 3) | 2)
