"""Certificates of a session: what they say, and whether the other end takes them."""

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

X509_V_FLAG_NO_CHECK_TIME = 0x200000
"""Of OpenSSL: a certificate that has expired is looked at all the same."""

HEARD_OUT_S = 0.5
"""In TLS 1.3 the other end says that it does not take a certificate after the handshake, if at all."""


@dataclass(frozen=True, slots=True)
class Material:
    """Files by which one end of a link is known, and knows the other; None where none is named."""

    authority: Path | None
    certificate: Path | None
    key: Path | None
    names_checked: bool


@dataclass(frozen=True, slots=True)
class Certificate:
    """What one says.

    Attributes:
        name: common name of its subject.
        names: for which hosts it is good.
        not_before_s, not_after_s: seconds since 1970.
    """

    name: str
    names: tuple[str, ...]
    not_before_s: float
    not_after_s: float


class CertificateError(Exception):
    """It cannot be used; says why."""


def material_of(settings: zenoh.Config, endpoint: Endpoint, role: Literal["connect", "listen"]) -> Material:
    """The files of an endpoint that is connected to, or listened on: what it says itself stands over what all say."""
    of_all: Mapping[str, Any] = json.loads(settings.get_json(TLS))
    own = dict(item.partition("=")[::2] for item in endpoint.settings.split(";") if item)

    def file(name: str) -> Path | None:
        told = own.get(f"{name}_file") or of_all.get(name)
        return Path(told) if told else None

    checked = own.get("verify_name_on_connect", of_all.get("verify_name_on_connect"))
    return Material(
        file("root_ca_certificate"),
        file(f"{role}_certificate"),
        file(f"{role}_private_key"),
        names_checked=checked not in (False, "false"),
    )


def read_certificate(material: Material, role: Literal["connect", "listen"]) -> Certificate:
    """The certificate of the material, which must come from its authority and have its key. That it has expired is for
    the caller to see.

    Raises:
        CertificateError: a file cannot be read, key and certificate are of different pairs, the authority is another,
            or the certificate is not for this role.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    # Whose certificate is looked at is the end that shows it; the other checks it.
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
        raise CertificateError(f"certificate and key cannot be used: {_words(error)}") from error
    except OSError as error:
        files = ", ".join(str(path) for path in (material.certificate, material.key, material.authority) if path)
        raise CertificateError(f"one of {files} cannot be read: {error.strerror}") from error
    try:
        seen = _shake_hands(server, client, of_client=role == "connect")
    except ssl.SSLCertVerificationError as error:
        raise CertificateError(error.verify_message) from error
    except ssl.SSLError as error:
        raise CertificateError(_words(error)) from error
    return _certificate(seen)


def shake_hands(endpoint: Endpoint, material: Material, timeout_s: float) -> Certificate:
    """The certificate of whoever answers at an endpoint, once both ends have taken each other's.

    Raises:
        CertificateError: one of the ends does not take the other's, or this is no TLS.
        OSError: nobody is there.
    """
    host, port = host_and_port(endpoint)
    try:
        context = ssl.create_default_context(cafile=material.authority)
        context.check_hostname = material.names_checked
        if material.certificate is not None:
            context.load_cert_chain(material.certificate, material.key)
        with (
            socket.create_connection((host, port), timeout_s) as link,
            context.wrap_socket(link, server_hostname=host) as tls,
        ):
            seen = tls.getpeercert() or {}
            tls.settimeout(HEARD_OUT_S)
            with suppress(TimeoutError):
                tls.recv(1)
            return _certificate(seen)
    except ssl.SSLCertVerificationError as error:
        raise CertificateError(f"this end does not take its certificate: {error.verify_message}") from error
    except ssl.SSLError as error:
        raise CertificateError(_alert(error)) from error


def host_and_port(endpoint: Endpoint) -> tuple[str, int]:
    """Of an endpoint with both."""
    host, _, port = endpoint.address.rpartition(":")
    return host.removeprefix("[").removesuffix("]"), int(port)


def _alert(error: ssl.SSLError) -> str:
    reason = _words(error)
    if "alert" in reason:
        return f"the other end refuses: {reason.rpartition('alert ')[2]}"
    return f"no TLS comes about: {reason}"


def _words(error: ssl.SSLError) -> str:
    """OpenSSL's reason, as people write."""
    return (error.reason or str(error)).lower().replace("_", " ")


def _shake_hands(server: ssl.SSLContext, client: ssl.SSLContext, *, of_client: bool) -> Mapping[str, Any]:
    """What the checking end sees of the other's certificate, both in memory."""
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
