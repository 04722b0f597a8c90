"""What a session is opened with: the configuration of the service over the file that it names."""

from __future__ import annotations

import json
import uuid
from typing import Any

import zenoh

from coec.adapters.zenoh.endpoints import Endpoint, redacted, without_secrets
from coec.adapters.zenoh.settings_file import TLS, read_settings
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConfigError

DEAF_US = 2_000_000
"""Who has not taken 64 kB for so long, microseconds, is cut off when something is to be sent to him that may not be
dropped: meanwhile a router forwards nothing of that sender to anybody. By default it would be 5 s for each."""


def settings_of(config: ZenohConfig, limits: LimitsConfig) -> zenoh.Config:
    """What `config.file` says stands; what it does not say opens no door: nobody listens, and nobody is looked for, who
    was not told to.

    Raises:
        ConfigError: the file or an endpoint is none, or a door is open to everybody and `config.insecure` is not set.
    """
    listen = config.listen if config.embedded_router else ()
    connect = tuple(endpoint for endpoint in config.connect if endpoint not in listen)
    for endpoint in (*listen, *connect):
        Endpoint.parse(endpoint)
    silent = {
        "mode": "router" if config.embedded_router else "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "scouting/gossip/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": DEAF_US,
    }
    try:
        settings = read_settings(config.file) if config.file else zenoh.Config()
        unsaid = zenoh.Config()
        for key, value in silent.items():
            # A peer listens on every interface by default, at any port.
            if settings.get_json(key) == unsaid.get_json(key):
                settings.insert_json5(key, json.dumps(value))
        settings.insert_json5("scouting/multicast/enabled", "false")
        settings.insert_json5("timestamping/enabled", "true")
        settings.insert_json5("transport/link/rx/max_message_size", str(limits.max_message_bytes))
        # The 16 MiB of every router and sender that is started anew would stay mapped until the service ends (Zenoh
        # 1.10). Without them a frame is copied once more: at 35 MB/s one hundredth of a core.
        settings.insert_json5("transport/shared_memory/enabled", "false")
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"{where(config)}: {without_secrets(str(error), endpoints_of(config))}") from None
    doors = unguarded(settings)
    if doors and not config.insecure:
        raise ConfigError(
            f"{where(config)}: whoever reaches {', '.join(doors)} would be let in, to read, to send frames and to give "
            "commands: listen on loopback, or on tls with enable_mtls and a root_ca_certificate; or set "
            "`zenoh.insecure: true`, and health will say so"
        )
    return settings


def unguarded(settings: zenoh.Config) -> tuple[str, ...]:
    """Endpoints that are listened on, as they may be shown, where a program on another computer gets in without a
    certificate.

    Raises:
        ConfigError: one of them is no endpoint.
    """
    certificates_asked = bool(json.loads(settings.get_json(TLS)).get("enable_mtls"))
    return tuple(
        redacted(endpoint)
        for endpoint in listened_of(settings)
        if Endpoint.parse(endpoint).lets_in_whoever_comes(certificates_asked=certificates_asked)
    )


def beside(settings: zenoh.Config, connect_s: float) -> zenoh.Config:
    """Make of a session's settings those of a client beside it, which sees what the router hands to others; it is
    opened within `connect_s`, or not at all."""
    own = {
        "mode": "client",
        "id": uuid.uuid4().hex.lstrip("0"),  # the file may name that of the service
        "listen/endpoints": [],
        "connect/timeout_ms": round(connect_s * 1000),
        "connect/exit_on_failure": True,
    }
    for key, value in own.items():
        settings.insert_json5(key, json.dumps(value))
    return settings


def listened_of(settings: zenoh.Config) -> tuple[str, ...]:
    """Endpoints at which the session listens, as they are written."""
    return _of_mode(json.loads(settings.get_json("listen/endpoints")), mode_of(settings))


def connected_of(settings: zenoh.Config) -> tuple[str, ...]:
    """Endpoints to which the session connects, as they are written."""
    return _of_mode(json.loads(settings.get_json("connect/endpoints")), mode_of(settings))


def mode_of(settings: zenoh.Config) -> str:
    """`router`, `peer` or `client`."""
    return str(json.loads(settings.get_json("mode")))


def endpoints_of(config: ZenohConfig) -> tuple[str, ...]:
    """All that the configuration names."""
    return (*config.listen, *config.connect)


def where(config: ZenohConfig) -> str:
    """What part of the configuration a complaint is about."""
    if config.file:
        return f"zenoh.file {config.file}"
    listen = [redacted(endpoint) for endpoint in config.listen] if config.embedded_router else []
    return f"zenoh.listen {listen}, connect {[redacted(endpoint) for endpoint in config.connect]}"


def _of_mode(value: Any, mode: str) -> tuple[str, ...]:
    """A list of endpoints, or one per mode; a list in the list is a choice of endpoints."""
    found = value.get(mode, []) if isinstance(value, dict) else value
    return tuple(one for item in found or [] for one in ([item] if isinstance(item, str) else item))
