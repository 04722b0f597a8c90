"""A vehicle's router, started from a Zenoh configuration (JSON5) as `zenohd` reads it."""

from __future__ import annotations

from pathlib import Path

import zenoh

from coec.adapters.zenoh.endpoints import without_secrets
from coec.adapters.zenoh.settings import check_certificates, mode_of, unguarded
from coec.adapters.zenoh.settings_file import read_settings
from coec.errors import ConfigError, UnavailableError

ROUTER = "router"


def open_router(file: Path) -> zenoh.Session:
    """A session that routes between all clients by the rules of the file, until it is closed.

    Raises:
        ConfigError: the file cannot be used, is not a router's, or lets anybody in, or a certificate cannot be used.
        UnavailableError: a port is taken, or an address is not there.
    """
    zenoh.init_log_from_env_or("error")
    settings = read_settings(file)
    if mode_of(settings) != ROUTER:
        raise ConfigError(f'{file}: its mode is {mode_of(settings)}: a router says `mode: "router"`')
    check_certificates(settings, str(file))
    doors = unguarded(settings)
    if doors:
        raise ConfigError(
            f"{file}: whoever reaches {', '.join(doors)} would be let in, to read, to send frames and to command: "
            "listen on loopback, or on tls with enable_mtls and a root_ca_certificate"
        )
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        raise UnavailableError(f"cannot open the router of {file}: {without_secrets(str(error), ())}") from None
