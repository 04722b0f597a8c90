"""Settings of a Zenoh session, from the service's configuration and the Zenoh file that it names."""

from __future__ import annotations

import json
import re
import uuid
from typing import Any

import zenoh

from coec.adapters.zenoh.endpoints import CERTIFIED, Endpoint, redacted, without_secrets
from coec.adapters.zenoh.settings_file import TLS, read_settings
from coec.adapters.zenoh.tls import Role, check_tls_files, tls_files
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConfigError

GOSSIP = "scouting/gossip/enabled"

DEAF_US = 2_000_000
"""A receiver that has not taken 64 kB for this long, microseconds, is cut off when a message for it may not be dropped.
Until then the router forwards nothing from that sender to anybody. Zenoh's default is 5 s for each receiver."""


OPEN_MS = 3_000
"""How long an endpoint may take to accept the session, ms. One that never answers delays the start, and the endpoints
behind it, by so much. The shipped router gives a connection up after 2 s; Zenoh's default is 10 s."""

RETRY = {"period_init_ms": 1000, "period_max_ms": 1000, "period_increase_factor": 1.0}
"""Pause between two attempts to reach a router. Zenoh's own grows to 4 s."""


def settings_of(config: ZenohConfig, limits: LimitsConfig) -> zenoh.Config:
    """The session's settings. What `config.file` sets stands. Whatever it leaves out gets a safe value: the session
    listens and searches for others only if told to.

    The session is a client of the router. A router hands nothing on between two peers, since it expects them to find
    each other by gossip and to connect; nodes of rmw_zenoh are peers. Clients get everything from the router. A file
    that names no mode, but where to listen, or gossip, makes it a peer: clients do neither.

    Raises:
        ConfigError: the file or an endpoint cannot be used, or an endpoint lets anybody in and `config.insecure` is not
            set.
    """
    listen = config.listen if config.embedded_router else ()
    connect = tuple(endpoint for endpoint in config.connect if endpoint not in listen)
    for endpoint in (*listen, *connect):
        Endpoint.parse(endpoint)
    silent = {
        "mode": "router" if config.embedded_router else "client",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/retry": RETRY,
        "transport/unicast/open_timeout": OPEN_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": DEAF_US,
    }
    try:
        settings = read_settings(config.file) if config.file else zenoh.Config()
        unsaid = zenoh.Config()
        if not config.embedded_router and _wants_peers(settings, unsaid):
            silent["mode"] = "peer"
        for key, value in silent.items():
            # By default a peer listens on every interface, at any port.
            if settings.get_json(key) == unsaid.get_json(key):
                settings.insert_json5(key, json.dumps(value))
        if settings.get_json(GOSSIP) == unsaid.get_json(GOSSIP):
            # By gossip a router makes its peers known to each other, without which they exchange nothing: default
            # nodes of rmw_zenoh. It connects to none of them itself.
            settings.insert_json5(GOSSIP, json.dumps(mode_of(settings) == "router"))
        settings.insert_json5("scouting/multicast/enabled", "false")
        settings.insert_json5("timestamping/enabled", "true")
        settings.insert_json5("transport/link/rx/max_message_size", str(limits.max_message_bytes))
        # With shared memory, 16 MiB of every router and sender that is started anew would stay mapped until the service
        # ends (Zenoh 1.10). Without it a frame is copied once more, which takes a hundredth of a core at 35 MB/s.
        settings.insert_json5("transport/shared_memory/enabled", "false")
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"{settings_source(config)}: {without_secrets(str(error), endpoints_of(config))}") from None
    doors = unguarded(settings)
    if doors and not config.insecure:
        raise ConfigError(
            f"{settings_source(config)}: whoever reaches {', '.join(doors)} would be let in, to read, to send frames and to give "
            "commands: listen on loopback, or on tls with enable_mtls and a root_ca_certificate; or set "
            "`zenoh.insecure: true`, and health will say so"
        )
    return settings


def check_certificates(settings: zenoh.Config, place: str) -> None:
    """Checks that this process can read the certificates and keys of a session, which Zenoh reports without their
    names, and that each key belongs to its certificate. `place` stands before the message.

    Raises:
        ConfigError: a file cannot be used; names it.
    """
    roles: tuple[tuple[Role, tuple[str, ...]], ...] = (
        ("listen", listened_of(settings)),
        ("connect", connected_of(settings)),
    )
    for role, endpoints in roles:
        for endpoint in map(Endpoint.parse, endpoints):
            if endpoint.protocol in CERTIFIED:
                check_tls_files(tls_files(settings, endpoint, role), f"{place}, {TLS}")


def unguarded(settings: zenoh.Config) -> tuple[str, ...]:
    """Endpoints on which the session listens and lets programs on other computers in without a certificate, redacted.

    Raises:
        ConfigError: one of them is malformed.
    """
    certificates_required = bool(json.loads(settings.get_json(TLS)).get("enable_mtls"))
    return tuple(
        redacted(endpoint)
        for endpoint in listened_of(settings)
        if Endpoint.parse(endpoint).admits_anyone(certificates_required=certificates_required)
    )


def to_observer(settings: zenoh.Config) -> zenoh.Config:
    """Changes a session's settings, in place, into those of a client beside it, which sees what the router gives to
    others."""
    own = {
        "id": _new_id(),
        "connect/endpoints": connected_of(settings),
        "mode": "client",
        "listen/endpoints": [],
    }
    for key, value in own.items():
        settings.insert_json5(key, json.dumps(value))
    return settings


def to_second_session(settings: zenoh.Config) -> zenoh.Config:
    """Changes a session's settings, in place, into those of a session of the same kind that may run at the same time:
    with an id of its own, and listening at free ports of the same addresses."""
    ports = re.compile(r":\d+(?=$|[?#])")
    listen = [ports.sub(":0", endpoint, count=1) for endpoint in listened_of(settings)]
    settings.insert_json5("id", json.dumps(_new_id()))
    settings.insert_json5("listen/endpoints", json.dumps(listen))
    return settings


def finds_peers(settings: zenoh.Config) -> bool:
    """Whether the session connects to peers that it learns of by gossip."""
    mode = mode_of(settings)
    if mode == "client" or json.loads(settings.get_json(GOSSIP)) is False:
        return False
    connects = json.loads(settings.get_json("scouting/gossip/autoconnect"))
    if isinstance(connects, dict):
        connects = connects.get(mode)
    return mode == "peer" if connects is None else bool(connects)


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
    """All endpoints in the configuration."""
    return (*config.listen, *config.connect)


def settings_source(config: ZenohConfig) -> str:
    """The part of the configuration that an error message is about."""
    if config.file:
        return f"zenoh.file {config.file}"
    listen = [redacted(endpoint) for endpoint in config.listen] if config.embedded_router else []
    return f"zenoh.listen {listen}, connect {[redacted(endpoint) for endpoint in config.connect]}"


def _wants_peers(settings: zenoh.Config, unsaid: zenoh.Config) -> bool:
    """Whether a file sets what only a peer does: it listens, or finds others by gossip."""
    listens = settings.get_json("listen/endpoints")
    if listens != unsaid.get_json("listen/endpoints") and _of_mode(json.loads(listens), "peer"):
        return True
    return json.loads(settings.get_json(GOSSIP)) is True


def _new_id() -> str:
    """An id of a session; the file may set the service's, and no two sessions have one."""
    return uuid.uuid4().hex.lstrip("0")


def _of_mode(value: Any, mode: str) -> tuple[str, ...]:
    """The endpoints of a mode. `value` is a list of endpoints, or holds one such list per mode; within the list,
    `locators` of an object are several endpoints."""
    configured = value.get(mode, []) if isinstance(value, dict) else value
    return tuple(one for item in configured or [] for one in ([item] if isinstance(item, str) else item["locators"]))
