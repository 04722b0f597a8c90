"""The HTTP server of a service, as its configuration has it at the moment."""

from __future__ import annotations

import logging
from collections.abc import Callable

from coec.adapters.system.http import HttpServer, Page
from coec.calibration.types import Reason
from coec.config import MetricsConfig
from coec.errors import UnavailableError

_log = logging.getLogger(__name__)

STOP_S = 1.0
"""For the thread to end: it looks five times a second."""


class HttpDoor:
    """Opened, moved and closed by the main thread. Metrics are for people who look after the service: that they cannot
    be had is said, and is no reason not to calibrate.

    Attributes:
        server: who answers now; None while nobody does.
        trouble: why nobody does though somebody should; None otherwise. It ails no calibration.
        insecure: that other computers get in; None otherwise.
    """

    def __init__(self, find: Callable[[str], Page | None]) -> None:
        """`find(path)` makes a page; see `HttpServer`."""
        self._find = find
        self._config = MetricsConfig()
        self.server: HttpServer | None = None
        self.trouble: Reason | None = None
        self.insecure: Reason | None = None

    def use(self, config: MetricsConfig) -> None:
        """Answer where this says, and nowhere else."""
        if config == self._config and self.trouble is None:
            return
        self.close(STOP_S)
        self._config, self.trouble, self.insecure = config, None, None
        if config.address is None:
            return
        try:
            self.server = HttpServer(*config.address, self._find)
        except UnavailableError as error:
            self.trouble = Reason("http_unavailable", f"Metrics are not served over HTTP: {error}.")
            _log.error(self.trouble.text)
            return
        self.server.thread.start()
        _log.info(f"metrics and health at http://{config.http}/metrics and /health")
        if config.is_open:
            text = f"Whoever reaches {config.http} can read the metrics: `metrics.insecure` is set. Listen on loopback."
            self.insecure = Reason("http_insecure", text)

    def close(self, deadline_s: float) -> bool:
        """Answer nobody any more; False when that took longer than the deadline."""
        server, self.server = self.server, None
        return server is None or server.close(deadline_s)
