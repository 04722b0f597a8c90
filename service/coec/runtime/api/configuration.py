"""The answer to `config`: the effective configuration without secrets."""

from __future__ import annotations

from typing import Any

from coec.adapters.zenoh.endpoints import redacted
from coec.config import Config


def redacted_configuration(config: Config) -> dict[str, Any]:
    """The configuration as JSON-like values. Keys and passwords in endpoints are hidden. The content of `zenoh.file` is
    not read."""
    document = config.model_dump(mode="json")
    for name in ("connect", "listen"):
        document["zenoh"][name] = [redacted(endpoint) for endpoint in document["zenoh"][name]]
    return document
