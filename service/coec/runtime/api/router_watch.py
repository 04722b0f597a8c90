"""Whether the router is there, in the log when it goes and comes, and as a reason of health while it is away."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from coec.calibration.types import Reason

_log = logging.getLogger(__name__)


class RouterWatch:
    """For one thread.

    Attributes:
        trouble: None while somebody is there.
    """

    def __init__(self, endpoints: Sequence[str], is_there: Callable[[], bool]) -> None:
        """`endpoints` as they may be shown; none where the service is the router itself."""
        self._endpoints = ", ".join(endpoints)
        self._is_there = is_there
        self._seen: bool | None = None
        self.trouble: Reason | None = None

    def look(self) -> None:
        """Look now. Zenoh itself tries again and again, without end."""
        if not self._endpoints:
            return
        there = self._is_there()
        if there == self._seen:
            return
        if there:
            _log.info(f"the router at {self._endpoints} is there")
            self.trouble = None
        else:
            away = "no router" if self._seen is None else "the router has gone: none"
            _log.warning(f"{away} at {self._endpoints}, trying again")
            text = (
                f"No router at {self._endpoints}: no frames come in and nobody is answered until there is one; "
                "`coec doctor` says what stands in the way."
            )
            self.trouble = Reason("no_router", text)
        self._seen = there
