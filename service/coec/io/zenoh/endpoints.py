"""Zenoh endpoints (`PROTOCOL/ADDRESS[?METADATA][#CONFIGURATION]`): whom they admit and which parts may be shown; the
Zenoh configuration file (JSON5); and the certificates of a session: what they contain, and whether the other end
accepts them.
"""

from __future__ import annotations

import json
import re
import socket
import ssl
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import zenoh

from coec.config import is_loopback
from coec.errors import ConfigError, cannot_read, require_readable
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
            certificates_asked: whether clients need a certificate if the endpoint itself does not say.
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
