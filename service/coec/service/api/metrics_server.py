"""The HTTP server of a service, by its present configuration, and its pages `/metrics`, `/health` and `/live`, for
programs on the same computer that scrape or probe.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping

from coec.calibration.types import Reason
from coec.config import MetricsConfig
from coec.errors import UnavailableError
from coec.io.http_server import HttpRequest, HttpResponse, HttpServer
from coec.schemas.replies import HealthReply, StatusReply
from coec.service.api.metrics import ENCODING, TEXT, TextFormat

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


USABLE_LEVELS = frozenset({0, 1})
"""ROS levels of health at which a calibration may be used: OK and WARN."""


def pages(
    metrics: Callable[[TextFormat], bytes],
    status: Callable[[], StatusReply],
    health: Callable[[], Mapping[str, HealthReply]],
    is_alive: Callable[[], bool],
) -> Callable[[HttpRequest], HttpResponse | None]:
    """A function that makes the page of a request (None for an unknown path).

    `/health` is 200 if the service runs and every pair may be used, else 503: a pair that was not looked at is not
    healthy. `/live` is 200 while the service makes progress, whatever it thinks of its pairs, else 503: only then can a
    restart help.
    """

    def page(request: HttpRequest) -> HttpResponse | None:
        match request.path:
            case "/metrics":
                text_format = accepted_format(request.accept)
                return HttpResponse(200, metrics(text_format), text_format.value)
            case "/health":
                return _health(status(), health())
            case "/live":
                alive = is_alive()
                return HttpResponse(
                    200 if alive else 503, b"alive\n" if alive else b"stuck\n", "text/plain; charset=utf-8"
                )
            case _:
                return None

    return page


def accepted_format(accept: str) -> TextFormat:
    """The format of the metrics for a header `Accept` (RFC 9110, 12.5.1): OpenMetrics if the reader names it and does
    not prefer plain text, else the text format, which every reader knows."""
    qualities = {ENCODING: 0.0, TEXT: 0.0}
    for item in accept.split(","):
        media_type, *parameters = (part.strip().lower() for part in item.split(";"))
        if media_type in qualities:
            qualities[media_type] = max(qualities[media_type], _quality(parameters))
    preferred = 0.0 < qualities[ENCODING] >= qualities[TEXT]
    return TextFormat.OPEN_METRICS if preferred else TextFormat.PROMETHEUS


def _quality(parameters: list[str]) -> float:
    """The quality among the parameters of a media type, 0 to 1; 1 if there is none, 0 if it is no number."""
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                quality = float(value)
            except ValueError:
                return 0.0
            return quality if 0.0 <= quality <= 1.0 else 0.0
    return 1.0


def _health(status: StatusReply, health: Mapping[str, HealthReply]) -> HttpResponse:
    good = status.state == "running" and all(reply.level in USABLE_LEVELS for reply in health.values())
    document = {
        "state": status.state,
        "pairs": {
            name: {
                "state": reply.state,
                "level": reply.level,
                "reasons": [{"code": reason.code, "text": reason.text} for reason in reply.reasons],
            }
            for name, reply in health.items()
        },
    }
    text = json.dumps(document, sort_keys=True, ensure_ascii=False) + "\n"
    return HttpResponse(200 if good else 503, text.encode(), "application/json")
