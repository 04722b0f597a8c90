"""What `config` says: the effective configuration, without what only the service itself may know."""

from __future__ import annotations

from typing import Any

from coec.adapters.zenoh.endpoints import redacted
from coec.config import Config


def shown(config: Config) -> dict[str, Any]:
    """The configuration as JSON-like values. Endpoints may hold keys and passwords: these are hidden. What
    `zenoh.file` holds is not looked at."""
    document = config.model_dump(mode="json")
    for name in ("connect", "listen"):
        document["zenoh"][name] = [redacted(endpoint) for endpoint in document["zenoh"][name]]
    return document
