"""Zenoh sessions: their settings from the service's configuration and the Zenoh file (JSON5) that it names; endpoints
(`PROTOCOL/ADDRESS[?METADATA][#CONFIGURATION]`), whom they admit and which parts may be shown; certificates, what
they contain, and whether the other end accepts them; opening a session within a time limit, or at once with a
connection that follows when a router answers; an embedded router; and whether programs on other computers may reach
a session.

Zenoh's own waiting (`connect/timeout_ms`) is switched off. With any other value than 0 a client tries the first
endpoint alone until the time is over, whatever other endpoints there are, and with -1 it never returns (Zenoh 1.10).
"""

from __future__ import annotations

import json
import os
import re
import socket
import ssl
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import zenoh

from coec.config import LimitsConfig, ZenohConfig, is_loopback
from coec.errors import ConfigError, UnavailableError, cannot_read, require_readable
from coec.io.system import IpAddress, Transport, listening_addresses
from coec.io.zenoh.command_auth import Credentials

WITH_PORT = frozenset({"tcp", "udp", "tls", "quic", "ws"})
OF_THIS_COMPUTER = frozenset({"unixsock-stream", "unixpipe"})
"""Protocols within this computer; the file system decides who may open them."""
CERTIFIED = frozenset({"tls", "quic"})
"""Protocols that can ask a client for its certificate."""
OTHERS = frozenset({"vsock", "serial"})

MTLS = "enable_mtls"
"""Key in an endpoint's configuration, and in `transport/link/tls` for endpoints that do not set it."""

HARMLESS = frozenset({"bind", "dscp", "iface", "multistream", "prio", "rel", "so_rcvbuf", "so_sndbuf", MTLS})
HARMLESS_ENDING = ("_certificate_file", "_private_key_file", "_on_connect", "_on_expiration")
"""Parameters that may be shown, because they are known to hold no secret. Any other might."""

HIDDEN = "***"

_FORM = re.compile(
    r"(?P<protocol>[a-z0-9-]+)/(?P<address>[^?#]*)(\?(?P<metadata>[^#]*))?(#(?P<settings>.*))?", re.DOTALL
)
_HOST_PORT = re.compile(r"(?P<host>.+):(?P<port>\d{1,5})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """The parts of an endpoint; `metadata` and `settings` as written, empty if there are none."""

    protocol: str
    address: str
    metadata: str
    settings: str

    @classmethod
    def parse(cls, text: str) -> Endpoint:
        """The endpoint in a text.

        Raises:
            ConfigError: the text is no endpoint on any network.
        """
        match = _FORM.fullmatch(text)
        if match is None:
            raise ConfigError(f"{redacted(text)!r} is not an endpoint: write PROTOCOL/ADDRESS, as tcp/127.0.0.1:7447")
        endpoint = cls(match["protocol"], match["address"], match["metadata"] or "", match["settings"] or "")
        if endpoint.protocol in WITH_PORT:
            parts = _HOST_PORT.fullmatch(endpoint.address)
            if parts is None or int(parts["port"]) > 65535:
                raise ConfigError(f"{redacted(text)!r} names no host and port: write tcp/127.0.0.1:7447")
        elif endpoint.protocol not in OF_THIS_COMPUTER | OTHERS:
            known = ", ".join(sorted(WITH_PORT | OF_THIS_COMPUTER | OTHERS))
            raise ConfigError(f"{redacted(text)!r} has a protocol unknown to Zenoh: {known}")
        return endpoint

    @property
    def on_loopback(self) -> bool:
        """Whether only programs on this computer can reach it."""
        return self.protocol in OF_THIS_COMPUTER or (self.protocol in WITH_PORT and _is_loopback(self.address))

    @property
    def port(self) -> int:
        """The port, for a protocol that has ports."""
        return int(self.address.rpartition(":")[2])

    def admits_anyone(self, *, certificates_required: bool) -> bool:
        """Whether a program on another computer gets in without a certificate if a session listens on this endpoint.

        Args:
            certificates_required: whether clients need a certificate if the endpoint itself does not say.
        """
        if self.on_loopback:
            return False
        setting = dict(item.partition("=")[::2] for item in self.settings.split(";")).get(MTLS)
        required = certificates_required if setting is None else setting == "true"
        return not (required and self.protocol in CERTIFIED)


def redacted(text: str) -> str:
    """An endpoint as it may be shown: the address stays, parameters that are not known to be harmless are hidden. In a
    text that is no endpoint, everything behind the first `?` or `#` is hidden."""
    match = _FORM.fullmatch(text)
    if match is None:
        head = re.split(r"[?#]", text, maxsplit=1)[0]
        return _without_user(head) + ("" if head == text else HIDDEN)
    metadata = "" if match["metadata"] is None else f"?{_shown(match['metadata'])}"
    settings = "" if match["settings"] is None else f"#{_shown(match['settings'])}"
    return f"{match['protocol']}/{_without_user(match['address'])}{metadata}{settings}"


def without_secrets(text: str, endpoints: tuple[str, ...]) -> str:
    """A message from Zenoh about these endpoints, as it may be shown."""
    for endpoint in sorted(endpoints, key=len, reverse=True):
        text = text.replace(endpoint, redacted(endpoint))
    return re.sub(r"(base64|password)(\W{1,3})[^\s;,\"')\]]+", rf"\1\2{HIDDEN}", text)


def _shown(parameters: str) -> str:
    shown = []
    for item in parameters.split(";"):
        name, equals, value = item.partition("=")
        harmless = name in HARMLESS or name.endswith(HARMLESS_ENDING)
        shown.append(item if harmless or not (equals and value) else f"{name}={HIDDEN}")
    return ";".join(shown)


def _without_user(address: str) -> str:
    """The address with a user and password before the host hidden."""
    return f"{HIDDEN}@{address.rpartition('@')[2]}" if "@" in address else address


def _is_loopback(address: str) -> bool:
    return is_loopback(address.rpartition(":")[0].removeprefix("[").removesuffix("]"))


TLS = "transport/link/tls"

MAX_SETTINGS_BYTES = 2**20
"""Largest file; the shipped rules of a router have 8 kB."""

MAX_BRACKETS = 10_000
"""Most opening brackets of a file; the shipped rules have 90. Zenoh's reader recurses for each nested bracket and
crashes the process when the stack is used up, which happens between 32,000 and 100,000 brackets on a stack of 8 MB."""

_PLACE = re.compile(r"--> (\d+):(\d+)")
_VALUE = re.compile(r"""(?<=variant )`[^`]*`|"[^"]*"?|'[^']*'?""")


def read_settings(path: Path) -> zenoh.Config:
    """The settings in a file.

    Raises:
        ConfigError: it cannot be read, or holds no settings. The message quotes none of its values, which may be keys
            and passwords.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_SETTINGS_BYTES + 1)
        text = data.decode("utf-8")
    except OSError as error:
        raise ConfigError(cannot_read(path, error)) from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is not UTF-8 text") from None
    brackets = text.count("{") + text.count("[")
    if len(data) > MAX_SETTINGS_BYTES or brackets > MAX_BRACKETS:
        raise ConfigError(
            f"{path} is no configuration of Zenoh: it has more than {MAX_SETTINGS_BYTES} bytes, or {MAX_BRACKETS} "
            "brackets"
        )
    try:
        return zenoh.Config.from_json5(text)
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"{path} is no configuration of Zenoh (JSON5): {_harmless(str(error))}") from None


def credentials_in(settings: zenoh.Config) -> Credentials | None:
    """Files of the certificate that a session with these settings shows when it connects; None: there are none."""
    tls = json.loads(settings.get_json(TLS))
    files = [tls.get(name) for name in ("connect_certificate", "connect_private_key", "root_ca_certificate")]
    if not all(isinstance(file, str) for file in files):
        return None
    certificate, private_key, root_ca = (Path(file) for file in files)
    return Credentials(certificate, private_key, root_ca)


def _harmless(text: str) -> str:
    """Zenoh's message about a file without the file's content: the message may quote a line or a value."""
    place = _PLACE.search(text)
    if place is not None:
        return f"line {place[1]}, column {place[2]}"
    return _VALUE.sub(f'"{HIDDEN}"', text.partition(" at /")[0])


X509_V_FLAG_NO_CHECK_TIME = 0x200000
"""OpenSSL flag: do not check the validity period, so that an expired certificate can be read, too."""

Role = Literal["connect", "listen"]
"""Which end of a link an endpoint is."""

REFUSAL_WAIT_S = 0.5
"""How long to listen after the handshake, s: in TLS 1.3 the other end refuses a certificate only after it, if at
all."""


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Files with which one end of a link identifies itself and checks the other end; None for a file that is not
    set."""

    authority: Path | None
    certificate: Path | None
    key: Path | None
    names_checked: bool


@dataclass(frozen=True, slots=True)
class Certificate:
    """Content of a certificate.

    Attributes:
        name: common name of its subject.
        names: hosts for which it is valid.
        not_before_s, not_after_s: validity period, seconds since 1970.
    """

    name: str
    names: tuple[str, ...]
    not_before_s: float
    not_after_s: float


class CertificateError(Exception):
    """A certificate cannot be used; says why."""


def tls_files(settings: zenoh.Config, endpoint: Endpoint, role: Role) -> TlsFiles:
    """The files for an endpoint to connect to or listen on. What the endpoint sets itself overrides the common TLS
    settings."""
    of_all: Mapping[str, Any] = json.loads(settings.get_json(TLS))
    own = dict(item.partition("=")[::2] for item in endpoint.settings.split(";") if item)

    def file(name: str) -> Path | None:
        value = own.get(f"{name}_file") or of_all.get(name)
        return Path(value) if value else None

    checked = own.get("verify_name_on_connect", of_all.get("verify_name_on_connect"))
    return TlsFiles(
        file("root_ca_certificate"),
        file(f"{role}_certificate"),
        file(f"{role}_private_key"),
        names_checked=checked not in (False, "false"),
    )


def check_tls_files(material: TlsFiles, where: str) -> None:
    """Checks that this process can read the files of one end of a link, and that the key belongs to the certificate.
    Validity periods are left to Zenoh: at a start the clock may not be set yet.

    Raises:
        ConfigError: it is not so; names the file.
    """
    files = [path for path in (material.authority, material.certificate, material.key) if path is not None]
    for path in files:
        require_readable(path, where)
    if material.certificate is None or material.key is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(material.certificate, material.key, password="")
    except (OSError, ValueError) as error:
        why = _reason_text(error) if isinstance(error, ssl.SSLError) else str(error)
        both = f"{material.certificate} and {material.key}"
        raise ConfigError(f"{where}: {both} are no certificate and its unencrypted key in PEM: {why}") from None


def read_certificate(material: TlsFiles, role: Role) -> Certificate:
    """The certificate of the material, which must be signed by its authority and fit its key. The caller has to check
    whether it has expired.

    Raises:
        CertificateError: a file cannot be read, key and certificate do not belong together, another authority signed
            it, or the certificate is not for this role.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    # One end shows the certificate, and the other end checks it.
    checks = server if role == "connect" else client
    checks.verify_mode = ssl.CERT_REQUIRED
    checks.verify_flags |= ssl.VerifyFlags(X509_V_FLAG_NO_CHECK_TIME)
    assert material.certificate is not None
    try:
        for context in (server, client):
            context.load_cert_chain(material.certificate, material.key)
        if material.authority is not None:
            checks.load_verify_locations(material.authority)
    except ssl.SSLError as error:
        raise CertificateError(f"certificate and key cannot be used: {_reason_text(error)}") from error
    except OSError as error:
        files = ", ".join(str(path) for path in (material.certificate, material.key, material.authority) if path)
        raise CertificateError(f"one of {files} cannot be read: {error.strerror}") from error
    try:
        seen = _shake_hands(server, client, of_client=role == "connect")
    except ssl.SSLCertVerificationError as error:
        raise CertificateError(error.verify_message) from error
    except ssl.SSLError as error:
        raise CertificateError(_reason_text(error)) from error
    return _certificate(seen)


def shake_hands(endpoint: Endpoint, material: TlsFiles, timeout_s: float) -> Certificate:
    """The certificate of the server at an endpoint, after both ends have accepted each other's.

    Raises:
        CertificateError: one end does not accept the other's certificate, or the server does not use TLS.
        OSError: nobody answers.
    """
    host, port = host_and_port(endpoint)
    try:
        context = ssl.create_default_context(cafile=material.authority)
        # From Python 3.13 on these refuse authorities without a key usage, which Zenoh accepts.
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        context.check_hostname = material.names_checked
        if material.certificate is not None:
            context.load_cert_chain(material.certificate, material.key)
        with (
            socket.create_connection((host, port), timeout_s) as link,
            context.wrap_socket(link, server_hostname=host) as tls,
        ):
            seen = tls.getpeercert() or {}
            tls.settimeout(REFUSAL_WAIT_S)
            with suppress(TimeoutError):
                tls.recv(1)
            return _certificate(seen)
    except ssl.SSLCertVerificationError as error:
        raise CertificateError(f"the peer's certificate is rejected: {error.verify_message}") from error
    except ssl.SSLError as error:
        raise CertificateError(_alert(error)) from error


def host_and_port(endpoint: Endpoint) -> tuple[str, int]:
    """Host and port of an endpoint that has both."""
    host, _, port = endpoint.address.rpartition(":")
    return host.removeprefix("[").removesuffix("]"), int(port)


def _alert(error: ssl.SSLError) -> str:
    reason = _reason_text(error)
    if "alert" in reason:
        return f"the other end refuses: {reason.rpartition('alert ')[2]}"
    return f"no TLS connection comes about: {reason}"


def _reason_text(error: ssl.SSLError) -> str:
    """OpenSSL's reason in plain words."""
    return (error.reason or str(error)).lower().replace("_", " ")


def _shake_hands(server: ssl.SSLContext, client: ssl.SSLContext, *, of_client: bool) -> Mapping[str, Any]:
    """The other end's certificate as the checking end sees it, after a handshake in memory."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(to_client, to_server), server.wrap_bio(to_server, to_client, server_side=True)]
    waiting = list(ends)
    for _ in range(10):
        for end in list(waiting):
            try:
                end.do_handshake()
                waiting.remove(end)
            except ssl.SSLWantReadError:
                pass
        if not waiting:
            break
    return ends[1 if of_client else 0].getpeercert() or {}


def _certificate(seen: Mapping[str, Any]) -> Certificate:
    subject = [value for part in seen.get("subject", ()) for name, value in part if name == "commonName"]
    return Certificate(
        name=subject[0] if subject else "",
        names=tuple(value for _, value in seen.get("subjectAltName", ())),
        not_before_s=ssl.cert_time_to_seconds(seen["notBefore"]) if "notBefore" in seen else 0.0,
        not_after_s=ssl.cert_time_to_seconds(seen["notAfter"]) if "notAfter" in seen else float("inf"),
    )


# --- settings and sessions --------------------------------------------------------------------------------------------

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
