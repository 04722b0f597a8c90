"""Certificates of a session: what they contain, and whether the other end accepts them."""

from __future__ import annotations

import json
import socket
import ssl
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import zenoh

from coec.adapters.zenoh.endpoints import Endpoint
from coec.adapters.zenoh.settings_file import TLS
from coec.errors import ConfigError, require_readable

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
        raise CertificateError(f"this end does not take its certificate: {error.verify_message}") from error
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
