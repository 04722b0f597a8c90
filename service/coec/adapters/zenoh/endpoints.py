"""Zenoh endpoints, `PROTOCOL/ADDRESS[?METADATA][#CONFIGURATION]`: whom they let in, and which parts may be shown."""

from __future__ import annotations

import re
from dataclasses import dataclass

from coec.config import is_loopback
from coec.errors import ConfigError

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
            raise ConfigError(f"{redacted(text)!r} is no endpoint: write PROTOCOL/ADDRESS, as tcp/127.0.0.1:7447")
        endpoint = cls(match["protocol"], match["address"], match["metadata"] or "", match["settings"] or "")
        if endpoint.protocol in WITH_PORT:
            parts = _HOST_PORT.fullmatch(endpoint.address)
            if parts is None or int(parts["port"]) > 65535:
                raise ConfigError(f"{redacted(text)!r} names no host and port: write tcp/127.0.0.1:7447")
        elif endpoint.protocol not in OF_THIS_COMPUTER | OTHERS:
            known = ", ".join(sorted(WITH_PORT | OF_THIS_COMPUTER | OTHERS))
            raise ConfigError(f"{redacted(text)!r} is of no protocol that Zenoh knows: {known}")
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
