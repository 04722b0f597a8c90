"""The HTTP pages `/metrics`, `/health` and `/live`, for programs on the same computer that scrape or probe."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from coec.adapters.system.http import HttpRequest, HttpResponse
from coec.runtime.api.metrics import ENCODING, TEXT, TextFormat
from coec.schemas.replies import HealthReply, StatusReply

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
