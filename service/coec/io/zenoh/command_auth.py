"""Two programs prove their names to each other with two questions and their answers, over any carrier.

A conversation is TLS 1.3 with certificates on both sides. Its bytes travel as payloads of questions and answers::

    speaker                              listener
    hello()      --  ClientHello  -->    hear()
    say(text)    <-- certificate, ... -- (bytes)
                 --  certificate, ..., text -->  hear()
    answer()     <-- sealed answer --    Heard

The carrier of the bytes cannot read, change, repeat or redirect what is said; it can only hold it back. Names are the
common names of the certificates, both signed by one authority. (RFC 8446; `ssl.MemoryBIO`.)
"""

from __future__ import annotations

import hashlib
import ssl
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.config import AuthorityConfig
from coec.errors import CoecError, ConfigError, NotProvenError, cannot_read

SECOND_QUERY_S = 5.0
"""How long the listener waits for the second question; a later one is refused. A carrier that holds a question back
gains at most this time."""

MAX_HANDSHAKES = 256
"""Most conversations that have begun and not ended, some 36 kB each. The oldest one makes room once it is `LEFT_S`
old."""

MAX_PAYLOAD_BYTES = 16_384
"""Most bytes that can be said: one record of TLS."""


MIN_HANDSHAKE_AGE_S = 1.0
"""Age before which no conversation is dropped for another. Two queries take some milliseconds, and on a busy computer a
hundred times that."""


class TooManyHandshakesError(CoecError):
    """Too many conversations have begun just now. Nothing was done, and the sender may begin again."""

    reply_code = "busy"


@dataclass(frozen=True, slots=True)
class Credentials:
    """PEM files: a certificate with its private key, and the authority that must have signed the certificates of
    others."""

    certificate: Path
    private_key: Path
    root_ca: Path


def credentials_of(config: AuthorityConfig) -> Credentials | None:
    """The credentials of the service; None: it has none."""
    if config.certificate is None or config.private_key is None or config.root_ca is None:
        return None
    return Credentials(config.certificate, config.private_key, config.root_ca)


@dataclass(frozen=True, slots=True)
class AuthenticatedCommand:
    """The end of a conversation: the speaker's name (common name of its certificate), what it said, and a function that
    encrypts an answer for it."""

    sender: str
    payload: bytes
    seal: Callable[[bytes], bytes]


class _TlsEndpoint:
    """One end of a connection that has no socket."""

    def __init__(self, context: ssl.SSLContext, *, server_side: bool) -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=server_side)

    def handshake(self, received: bytes) -> bool:
        """Whether the other end has proven its name; if not, its next bytes are needed.

        Raises:
            NotProvenError: it cannot.
        """
        self._incoming.write(received)
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return False
        except ssl.SSLError as error:
            raise NotProvenError(f"the certificate was rejected: {_why(error)}") from None
        return True

    def peer(self) -> str:
        """The common name in the other end's certificate."""
        subject: Any = (self._tls.getpeercert() or {}).get("subject", ())
        names = [value for part in subject for kind, value in part if kind == "commonName"]
        if len(names) != 1:
            raise NotProvenError(f"the certificate has {len(names)} common names; it must have one")
        return str(names[0])

    def read(self, received: bytes = b"") -> bytes:
        """What the other end said, in one record."""
        self._incoming.write(received)
        try:
            return self._tls.read(MAX_PAYLOAD_BYTES)
        except ssl.SSLError as error:
            raise NotProvenError(f"the message cannot be decrypted: {_why(error)}") from None

    def write(self, text: bytes) -> None:
        """Say something, in one record."""
        if len(text) > MAX_PAYLOAD_BYTES:
            raise NotProvenError(f"more than {MAX_PAYLOAD_BYTES} bytes cannot be sent")
        self._tls.write(text)

    def outgoing(self) -> bytes:
        """Bytes for the other end."""
        return self._outgoing.read()


class CommandListener:
    """The service's end, which takes part in many conversations at once. For use by one thread.

    Attributes:
        digest: SHA-256 of the content of its files.
    """

    def __init__(self, credentials: Credentials, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` returns seconds.

        Raises:
            ConfigError: a file cannot be used; names it.
        """
        self._context = _context(credentials, ssl.PROTOCOL_TLS_SERVER)
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._context.num_tickets = 0  # no conversation is resumed
        self.digest = _digest(credentials)
        self._clock = clock
        self._pending: OrderedDict[str, tuple[_TlsEndpoint, float]] = OrderedDict()

    def renewed(self, credentials: Credentials) -> CommandListener:
        """A listener that continues the conversations begun here and uses these files, read now, for new ones. For any
        thread. Do not use this one afterwards.

        Raises:
            ConfigError: a file cannot be used; then this listener stays in use.
        """
        fresh = CommandListener(credentials, self._clock)
        fresh._pending = self._pending
        return fresh

    def receive(self, handshake_id: str, received: bytes) -> bytes | AuthenticatedCommand:
        """Takes the next bytes of the conversation with this id, which its speaker chose. Returns the bytes to send
        back, or the end of the conversation.

        Raises:
            NotProvenError: the speaker cannot prove its name, or took too long.
            TooManyHandshakesError: the conversation would begin, but there is no room.
        """
        now_s = self._clock()
        while self._pending and next(iter(self._pending.values()))[1] < now_s:
            self._pending.popitem(last=False)
        endpoint, _ = self._pending.pop(handshake_id, (None, 0.0))
        if endpoint is None:
            return self._begin(handshake_id, received, now_s)
        if not endpoint.handshake(received):
            raise NotProvenError("the TLS session was aborted")
        return AuthenticatedCommand(endpoint.peer(), endpoint.read(), _sealer(endpoint))

    def _begin(self, handshake_id: str, received: bytes, now_s: float) -> bytes:
        if len(self._pending) >= MAX_HANDSHAKES:
            # Conversations that have begun get time to go on, so that a flood of new ones makes others wait but ends
            # none.
            if next(iter(self._pending.values()))[1] > now_s + SECOND_QUERY_S - MIN_HANDSHAKE_AGE_S:
                raise TooManyHandshakesError("too many TLS handshakes are in progress; retry in a moment")
            self._pending.popitem(last=False)
        endpoint = _TlsEndpoint(self._context, server_side=True)
        endpoint.handshake(received)
        flight = endpoint.outgoing()
        if not flight:
            raise NotProvenError("not a TLS ClientHello")
        self._pending[handshake_id] = endpoint, now_s + SECOND_QUERY_S
        return flight


class CommandSender:
    """The sender's end of one conversation."""

    def __init__(self, credentials: Credentials, to: str) -> None:
        """`to` is the common name of the listener.

        Raises:
            ConfigError: as `Listener`.
        """
        context = _context(credentials, ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False  # the name is not that of a host: `say` checks it
        self._endpoint = _TlsEndpoint(context, server_side=False)
        self._to = to

    def first_flight(self) -> bytes:
        """The first bytes."""
        self._endpoint.handshake(b"")
        return self._endpoint.outgoing()

    def send(self, received: bytes, text: bytes) -> bytes:
        """The bytes that end the conversation, after the listener has proven its name.

        Raises:
            NotProvenError: it has another name or no proof; nothing of the text was sent.
        """
        if not self._endpoint.handshake(received):
            raise NotProvenError("the reply contains no certificate")
        name = self._endpoint.peer()
        if name != self._to:
            raise NotProvenError(f"who answered has the certificate of {name!a}, not that of {self._to!r}")
        self._endpoint.write(text)
        return self._endpoint.outgoing()

    def reply(self, received: bytes) -> bytes:
        """The listener's answer.

        Raises:
            NotProvenError: these bytes are not from the listener.
        """
        return self._endpoint.read(received)


def _sealer(endpoint: _TlsEndpoint) -> Callable[[bytes], bytes]:
    def sealed(text: bytes) -> bytes:
        endpoint.write(text)
        return endpoint.outgoing()

    return sealed


def _context(credentials: Credentials, protocol: int) -> ssl.SSLContext:
    _digest(credentials)  # names a file that cannot be read, which OpenSSL does not
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_verify_locations(credentials.root_ca)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{credentials.root_ca} is no certificate of an authority: {_reason(error)}") from None
    try:
        context.load_cert_chain(credentials.certificate, credentials.private_key, password=_no_password)
    except (OSError, ValueError) as error:
        both = f"{credentials.certificate} and {credentials.private_key}"
        raise ConfigError(f"{both} are no certificate and its unencrypted key in PEM: {_reason(error)}") from None
    return context


def _digest(credentials: Credentials) -> str:
    digest = hashlib.sha256()
    for path in (credentials.certificate, credentials.private_key, credentials.root_ca):
        try:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        except OSError as error:
            raise ConfigError(cannot_read(path, error)) from None
    return digest.hexdigest()


def _no_password() -> str:
    """An empty password for an encrypted key. Without it OpenSSL asks at the terminal and a service waits for ever."""
    return ""


def _reason(error: Exception) -> str:
    return _why(error) if isinstance(error, ssl.SSLError) else getattr(error, "strerror", None) or type(error).__name__


def _why(error: ssl.SSLError) -> str:
    """OpenSSL's reason, which quotes nothing that was received."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return error.verify_message
    return (error.reason or "malformed").lower().replace("_", " ")
