"""The HTTP server of a service, by its present configuration."""

from __future__ import annotations

import logging
from collections.abc import Callable

from coec.adapters.system.http import HttpRequest, HttpResponse, HttpServer
from coec.calibration.types import Reason
from coec.config import MetricsConfig
from coec.errors import UnavailableError

_log = logging.getLogger(__name__)

STOP_S = 1.0
"""Time for the thread to end, s: it looks five times a second."""


class MetricsServer:
    """The HTTP server, which the main thread opens, moves and closes. Metrics are for people who look after the
    service. If they cannot be served, that is reported, but the service calibrates all the same.

    Attributes:
        server: the present server; None if there is none.
        trouble: why there is no server although there should be one; else None. It does not affect calibrations.
        insecure: the reason to report if other computers can reach the server; else None.
    """

    def __init__(self, find: Callable[[HttpRequest], HttpResponse | None]) -> None:
        """`find(request)` makes a page; see `HttpServer`."""
        self._find = find
        self._config = MetricsConfig()
        self.server: HttpServer | None = None
        self.problem: Reason | None = None
        self.insecure: Reason | None = None

    def reconfigure(self, config: MetricsConfig) -> None:
        """Answers at the address of this configuration, and nowhere else."""
        if config == self._config and self.problem is None:
            return
        self.close(STOP_S)
        self._config, self.problem, self.insecure = config, None, None
        if config.address is None:
            return
        try:
            self.server = HttpServer(*config.address, self._find)
        except UnavailableError as error:
            self.problem = Reason("http_unavailable", f"Metrics are not served over HTTP: {error}.")
            _log.error(self.problem.text)
            return
        self.server.thread.start()
        _log.info(f"metrics at http://{config.http}/metrics, health at /health, liveness at /live")
        if config.is_open:
            text = f"Whoever reaches {config.http} can read the metrics: `metrics.insecure` is set. Listen on loopback."
            self.insecure = Reason("http_insecure", text)

    def close(self, deadline_s: float) -> bool:
        """Ends the server; False if that took longer than the deadline."""
        server, self.server = self.server, None
        return server is None or server.close(deadline_s)
