"""Watches whether the router is there. The log says when it goes and comes, and now and then while it is away; `health`
gives it as a reason all that time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from coec.calibration.types import Reason

_log = logging.getLogger(__name__)

FIRST_REMINDER_S, LONGEST_REMINDER_S = 60.0, 3600.0
"""Times after which the log repeats that there is no router, s: a minute, then twice as long each time, up to an hour.
So the last screen of a log shows it, and a night without a router gives twenty lines."""


class RouterMonitor:
    """For one thread.

    Attributes:
        trouble: the reason while there is no router; None while there is one.
    """

    def __init__(
        self, endpoints: Sequence[str], is_there: Callable[[], bool], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`endpoints` are in the form that may be shown; empty if the service is the router itself."""
        self._endpoints = ", ".join(endpoints)
        self._is_there = is_there
        self._now_s = now_s
        self._seen: bool | None = None
        self._away_since_s = self._reported_s = 0.0
        self._reminder_s = FIRST_REMINDER_S
        self.problem: Reason | None = None

    def check(self) -> None:
        """Looks now. Zenoh itself tries to connect again and again, without end."""
        if not self._endpoints:
            return
        there = self._is_there()
        now_s = self._now_s()
        if there == self._seen:
            if not there and now_s - self._reported_s >= self._reminder_s:
                _log.warning(f"no router at {self._endpoints} for {now_s - self._away_since_s:.0f} s, trying again")
                self._reported_s, self._reminder_s = now_s, min(2.0 * self._reminder_s, LONGEST_REMINDER_S)
            return
        if there:
            again = "" if self._seen is None else f" again, after {now_s - self._away_since_s:.0f} s"
            _log.info(f"the router at {self._endpoints} is there{again}")
            self.problem = None
        else:
            self._away_since_s = self._reported_s = now_s
            self._reminder_s = FIRST_REMINDER_S
            away = "no router" if self._seen is None else "the router has gone: none"
            _log.warning(f"{away} at {self._endpoints}, trying again")
            text = (
                f"No router at {self._endpoints}: no frames come in and nobody is answered until there is one; "
                "`coec doctor` says what stands in the way."
            )
            self.problem = Reason("no_router", text)
        self._seen = there
