"""A client that comes with a Zenoh configuration of its own: its router, its certificate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh

from coec.adapters.zenoh.client import ConnectionFailedError
from coec.adapters.zenoh.endpoints import without_secrets
from coec.errors import ConfigError


@contextmanager
def connected_by_file(file: Path, wait_s: float) -> Iterator[zenoh.Session]:
    """A client session as a Zenoh configuration (JSON5) says, closed at the end.

    Raises:
        ConfigError: the file is none.
        ConnectionFailedError: no router that takes the certificate answered within `wait_s`.
    """
    zenoh.init_log_from_env_or("off")
    try:
        settings = zenoh.Config.from_file(file)
    except (zenoh.ZError, OSError, ValueError) as error:
        raise ConfigError(f"{file}: {without_secrets(str(error), ())}") from None
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("listen/endpoints", "[]")
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("connect/timeout_ms", str(round(wait_s * 1000)))
    settings.insert_json5("connect/exit_on_failure", "true")
    try:
        session = zenoh.open(settings)
    except zenoh.ZError as error:
        raise ConnectionFailedError(
            f"no Zenoh router let us in by {file} within {wait_s:g} s ({without_secrets(str(error), ())}): check that "
            "it runs, its endpoint, and whether the certificate is one that it knows and is not expired"
        ) from None
    try:
        yield session
    finally:
        session.close()
