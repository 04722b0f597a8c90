"""Zenoh sessions: their settings from the service's configuration and the Zenoh file that it names; opening one within
a time limit, or at once with a connection that follows when a router answers; an embedded router; and whether
programs on other computers may reach a session.

Zenoh's own waiting (`connect/timeout_ms`) is switched off. With any other value than 0 a client tries the first
endpoint alone until the time is over, whatever other endpoints there are, and with -1 it never returns (Zenoh 1.10).
"""

import json
import os
import re
import tempfile
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConfigError, UnavailableError
from coec.io.system import IpAddress, Transport, listening_addresses
from coec.io.zenoh.endpoints import (
    CERTIFIED,
    TLS,
    WITH_PORT,
    Endpoint,
    Role,
    check_tls_files,
    read_settings,
    redacted,
    tls_files,
    without_secrets,
)

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
            f"{settings_source(config)}: whoever reaches {', '.join(doors)} would be let in, to read, to send "
            "frames and to give commands: listen on loopback, or on tls with enable_mtls and a root_ca_certificate; "
            "or set `zenoh.insecure: true`, and health will say so"
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


RETRY_S = 0.1
"""Pause between two attempts to reach a router within a time limit."""

LEFT_S = 2.0
"""Timeout until a session has left the router that it was opened with; takes milliseconds."""

_PROTOCOLS = "transport/link/protocols"
_USER = "transport/auth/usrpwd"
_UNIX = "unixsock-stream"


def open_client(settings: zenoh.Config, within_s: float) -> zenoh.Session:
    """A client session with the first of the endpoints that answers. Changes `settings`.

    Raises:
        ZError: none answered within the time limit.
    """
    endpoints = max(len(connected_of(settings)), 1)
    _insert(settings, "connect/timeout_ms", 0)
    _insert(settings, "connect/exit_on_failure", True)
    # An endpoint that takes connections and never answers must not use up the time of the others.
    _insert(settings, "transport/unicast/open_timeout", max(round(within_s * 1000 / endpoints), 1))
    deadline_s = time.monotonic() + within_s
    while True:
        try:
            return zenoh.open(settings)
        except zenoh.ZError:
            if time.monotonic() + RETRY_S >= deadline_s:
                raise
        time.sleep(RETRY_S)


def open_waiting(settings: zenoh.Config) -> zenoh.Session:
    """A client session that is open at once, whether or not a router answers. It connects to the first endpoint that
    answers, as soon as one does, and again whenever its router has gone. Changes `settings`.

    Zenoh opens no client session without a router, but one that has lost its router connects again by itself, for ever.
    So where no router answers, the session is opened with a router of this process, which then ends.

    Raises:
        ZError: the session cannot be opened even so.
    """
    _insert(settings, "connect/timeout_ms", 0)
    _insert(settings, "connect/exit_on_failure", True)
    with suppress(zenoh.ZError):
        return zenoh.open(settings)
    with tempfile.TemporaryDirectory(prefix="coec-") as folder:
        # The session keeps the endpoint for good. By this path nobody can listen there once the folder is removed, not
        # even who makes a folder of the same name; it holds while the descriptor is open: as long as the process runs.
        place = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        endpoint = f"{_UNIX}//proc/self/fd/{place}/router"
        with zenoh.open(_router_for(settings, endpoint, Path(folder))) as router:
            _insert(settings, "connect/endpoints", [endpoint, *connected_of(settings)])
            allowed = json.loads(settings.get_json(_PROTOCOLS))
            if allowed:
                _insert(settings, _PROTOCOLS, [*allowed, _UNIX])
            session = zenoh.open(settings)
            own = str(router.info.zid())
    deadline_s = time.monotonic() + LEFT_S
    while own in map(str, session.info.routers_zid()) and time.monotonic() < deadline_s:
        time.sleep(0.001)
    return session


def _router_for(client: zenoh.Config, endpoint: str, folder: Path) -> zenoh.Config:
    """Settings of a router that this client accepts, and that accepts it; the folder is nobody else's."""
    settings = zenoh.Config()
    _insert(settings, "mode", "router")
    _insert(settings, "listen/endpoints", [endpoint])
    _insert(settings, "scouting/multicast/enabled", False)
    _insert(settings, "scouting/gossip/enabled", False)
    _insert(settings, "scouting/delay", 0)
    _insert(settings, "transport/shared_memory/enabled", False)
    user = json.loads(client.get_json(_USER))
    if user.get("user") is not None:
        # A client that gives a name and a password leaves a router that does not ask for them.
        names = folder / "names"
        names.touch(mode=0o600)
        names.write_text(f"{user['user']}:{user.get('password')}\n")
        _insert(settings, f"{_USER}/dictionary_file", str(names))
    return settings


def _insert(settings: zenoh.Config, key: str, value: object) -> None:
    settings.insert_json5(key, json.dumps(value))


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
            f"{file}: whoever reaches {', '.join(doors)} could read, send frames and give commands: "
            "listen on loopback, or on tls with enable_mtls and a root_ca_certificate"
        )
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        raise UnavailableError(f"cannot open the router of {file}: {without_secrets(str(error), ())}") from None


OVER_UDP = frozenset({"udp", "quic"})


class Reach:
    """Reach of a session with these settings."""

    def __init__(
        self, settings: zenoh.Config, addresses: Callable[[Transport, int], set[IpAddress]] = listening_addresses
    ) -> None:
        """`addresses(protocol, port)` returns the addresses of this computer at which somebody listens on a port.

        Raises:
            ConfigError: an endpoint is malformed.
        """
        self._listened = listened_of(settings)
        self._connected = connected_of(settings)
        self._finds_peers = finds_peers(settings)
        self._addresses = addresses

    def exposure(self) -> str | None:
        """A clause that says why programs on other computers may reach the session; None: as far as this computer can
        tell they cannot. Examined anew at each call, because a router may be started or stopped at any time."""
        if self._finds_peers:
            return "it connects to peers that it learns of by gossip"
        for text in (*self._listened, *self._connected):
            endpoint = Endpoint.parse(text)
            if not endpoint.on_loopback:
                does = "listens at" if text in self._listened else "connects to"
                return f"it {does} {redacted(text)}"
        for text in self._connected:
            endpoint = Endpoint.parse(text)
            if endpoint.protocol in WITH_PORT and (why := self._also_elsewhere(endpoint)):
                return why
        return None

    def _also_elsewhere(self, router: Endpoint) -> str | None:
        protocol: Transport = "udp" if router.protocol in OVER_UDP else "tcp"
        port = router.port
        try:
            addresses = self._addresses(protocol, port)
        except OSError:
            return "this system does not show where its router listens"
        wide = sorted(str(address) for address in addresses if not address.is_loopback)
        return f"its router's port {port} is open at {wide[0]}, too" if wide else None
