"""The HTTP pages `/metrics` and `/health`, for programs on the same computer that scrape or probe."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from coec.adapters.system.http import Page
from coec.runtime.api.metrics import ENCODING
from coec.schemas.replies import HealthReply, StatusReply

METRICS_TYPE = f"{ENCODING}; version=1.0.0; charset=utf-8"

GOOD_ENOUGH = frozenset({0, 1})
"""ROS levels of health at which a calibration may be used: OK and WARN."""


def pages(
    metrics: Callable[[], bytes], status: Callable[[], StatusReply], health: Callable[[], Mapping[str, HealthReply]]
) -> Callable[[str], Page | None]:
    """A function that makes the page of a path (None for an unknown path). `/health` is 200 if the service runs and
    every pair may be used, else 503: a pair that was not looked at is not healthy."""

    def page(path: str) -> Page | None:
        match path:
            case "/metrics":
                return Page(200, metrics(), METRICS_TYPE)
            case "/health":
                return _health(status(), health())
            case _:
                return None

    return page


def _health(status: StatusReply, health: Mapping[str, HealthReply]) -> Page:
    good = status.state == "running" and all(reply.level in GOOD_ENOUGH for reply in health.values())
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
    return Page(200 if good else 503, text.encode(), "application/json")
