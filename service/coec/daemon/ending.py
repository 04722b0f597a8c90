"""Steps of an orderly end: each one is tried, and none waits longer than its time limit."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from coec.adapters.system.threads import ServiceThread

_log = logging.getLogger(__name__)


def attempt(name: str, step: Callable[[], object]) -> object:
    """Runs one step of the end and returns its result. If it raises, the exception is logged, and the result is
    None."""
    try:
        return step()
    except Exception:
        _log.exception("a step of the shutdown failed", extra={"fields": {"step": name}})
        return None


def stopped(threads: Sequence[ServiceThread], timeout_s: float) -> bool:
    for thread in threads:
        thread.request_stop()
    return joined(threads, timeout_s)


def joined(threads: Sequence[ServiceThread], timeout_s: float) -> bool:
    """Waits for threads that were asked to stop. If one does not stop within the time, logs that and returns False."""
    deadline_s = time.monotonic() + timeout_s
    late = [thread.name for thread in threads if not thread.join(max(deadline_s - time.monotonic(), 0.0))]
    if late:
        _log.error("threads did not stop in time", extra={"fields": {"threads": late}})
    return not late
