"""The client end of the bus: a session that queries and publishes, for the command line and for tests."""

from __future__ import annotations

import getpass
import json
import re
import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import zenoh

from coec.adapters.zenoh.endpoints import redacted
from coec.adapters.zenoh.settings_file import read_settings
from coec.errors import ConnectionFailedError, DecodeError, NotFoundError, RemoteError, UsageError
from coec.schemas.base import from_json, from_msgpack
from coec.schemas.keys import MAX_COMMAND_TIMEOUT_MS, Keys
from coec.schemas.replies import ErrorReply

JSON = "application/json"
ENDPOINT = re.compile(r"[a-z0-9-]+/[^\s/].*")
"""PROTOCOL/ADDRESS, as Zenoh writes it."""

ON_SITE = 0.9
"""Share of the client's waiting time that the service may take for a command; the rest is for the way there and
back."""

TIMEOUT_PAYLOAD = b"Timeout"
"""Zenoh's own reply if nobody finished the query in time."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer; `encoding` is the sender's description of the payload."""

    key: str
    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Way:
    """How to reach a router: at the first of the endpoints that answers, with the session settings of a file (Zenoh
    configuration, JSON5; None: default settings)."""

    endpoints: tuple[str, ...]
    file: Path | None = None


@contextmanager
def connected(endpoints: Sequence[str], wait_s: float) -> Iterator[zenoh.Session]:
    """As `connected_by`, with endpoints and default settings."""
    with connected_by(Way(tuple(endpoints)), wait_s) as session:
        yield session


@contextmanager
def connected_by(way: Way, wait_s: float, max_message_bytes: int | None = None) -> Iterator[zenoh.Session]:
    """A client session with the first router that answers, closed at the end. `max_message_bytes` is the largest
    message that it receives; None: as the file says, or a gigabyte.

    Raises:
        UsageError: an endpoint is malformed.
        ConfigError: the file cannot be used.
        ConnectionFailedError: no router answered within `wait_s`.
    """
    settings = zenoh.Config() if way.file is None else read_settings(way.file)
    for endpoint in way.endpoints:
        if not ENDPOINT.fullmatch(endpoint):
            raise UsageError(
                f"{redacted(endpoint)!r} is no endpoint of a router: write PROTOCOL/ADDRESS, as tcp/127.0.0.1:7447"
            )
    zenoh.init_log_from_env_or("off")
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("listen/endpoints", "[]")
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("connect/timeout_ms", str(round(wait_s * 1000)))
    settings.insert_json5("connect/exit_on_failure", "true")
    if max_message_bytes is not None:
        settings.insert_json5("transport/link/rx/max_message_size", str(max_message_bytes))
    # Publishers that keep their last message for late subscribers need timestamps.
    settings.insert_json5("timestamping/enabled", "true")
    try:
        settings.insert_json5("connect/endpoints", json.dumps(way.endpoints))
        session = zenoh.open(settings)
    except (zenoh.ZError, ValueError) as error:
        asked = ", ".join(redacted(endpoint) for endpoint in way.endpoints)
        by_certificate = any(endpoint.startswith(("tls/", "quic/")) for endpoint in way.endpoints)
        refused = ", or it refuses the certificate (`openssl x509 -in FILE -noout -subject -issuer -dates`)"
        raise ConnectionFailedError(
            f"no Zenoh router answered at {asked} within {wait_s:g} s{refused if by_certificate else ''}: start one, "
            "start `coec run --embedded-router`, or name the endpoint with --connect"
        ) from error
    try:
        yield session
    finally:
        session.close()


def key_expression(text: str) -> str:
    """`text`, checked to be a key or a key expression that stands for several.

    Raises:
        UsageError: it is neither; says why.
    """
    if "?" in text:
        raise UsageError(f"{text!r} is no key: parameters are given apart (`coec query KEY --param NAME=VALUE`)")
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError as error:
        raise UsageError(f"{text!r} is no key: {_first_clause(str(error))}") from error
    return text


def single_key(text: str) -> str:
    """`text`, checked to be a key that names one thing.

    Raises:
        UsageError: it is no key, or it is an expression that stands for several.
    """
    if "*" in key_expression(text):
        raise UsageError(f"{text!r} stands for several keys: name one, without `*`")
    return text


def _first_clause(text: str) -> str:
    """Zenoh's message about a key, without the place in Zenoh's source."""
    return text.partition(" at /")[0].partition("`: ")[2] or text


def ask(
    session: zenoh.Session,
    selector: str,
    timeout_s: float,
    payload: bytes | None = None,
    attachment: bytes | None = None,
) -> list[Reply]:
    """Every answer to a query, in the order of their keys; an empty list if nobody answers. The attachment says who
    asks, for the log of the service.

    Raises:
        UsageError: the selector does not begin with a key expression.
        RemoteError: somebody replied with an error, or somebody timed out and nobody else answered.
    """
    asked = session.get(
        selector,
        target=target_of(selector),
        timeout=timeout_s,
        payload=payload,
        encoding=JSON if payload is not None else None,
        attachment=attachment,
    )
    return answered(selector, timeout_s, asked)


def target_of(selector: str) -> zenoh.QueryTarget:
    """Which queryables are asked: the nearest complete one for a key, all of them for a key expression.

    Raises:
        UsageError: the selector does not begin with a key expression.
    """
    key = key_expression(selector.partition("?")[0])
    return zenoh.QueryTarget.ALL if "*" in key else zenoh.QueryTarget.BEST_MATCHING


def answered(selector: str, timeout_s: float, asked: Iterable[zenoh.Reply]) -> list[Reply]:
    """The answers to a query, in the order of their keys.

    Raises:
        RemoteError: somebody replied with an error, or somebody timed out and nobody else answered.
    """
    replies: list[Reply] = []
    timed_out = False
    for reply in asked:
        if reply.ok is not None:
            sample = reply.ok
            replies.append(Reply(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))
        elif reply.err is not None:
            content = reply.err.payload.to_bytes()
            if content != TIMEOUT_PAYLOAD:
                raise _remote_error(content, str(reply.err.encoding))
            timed_out = True
    if timed_out and not replies:
        raise too_late(selector, timeout_s)
    return sorted(replies, key=lambda reply: reply.key)


def too_late(selector: str, timeout_s: float) -> RemoteError:
    """The error for a query that somebody received but did not answer in time."""
    return RemoteError("timeout", f"no answer to {selector} within {timeout_s:g} s: the service is too busy")


def myself() -> bytes:
    """The name that a sender gives with a command, for the log and for a rate limit per sender. It proves nothing."""
    with suppress(OSError, KeyError):  # a user without a name
        return f"{getpass.getuser()}@{socket.gethostname()}".encode("ascii", errors="replace")
    return socket.gethostname().encode("ascii", errors="replace")


def patience_ms(timeout_s: float) -> int:
    """Time within which the service must begin a command, ms, if the client waits `timeout_s` for the acknowledgement;
    later the service does not carry it out."""
    return min(max(round(timeout_s * 1e3 * ON_SITE), 1), MAX_COMMAND_TIMEOUT_MS)


def ask_one(session: zenoh.Session, selector: str, timeout_s: float, payload: bytes | None = None) -> Reply:
    """The answer to a query for one key, the first if there are several.

    Raises:
        NotFoundError: nobody answered; says what to check.
        RemoteError: as `ask`.
    """
    replies = ask(session, selector, timeout_s, payload)
    if not replies:
        raise nobody(selector)
    return replies[0]


def is_alive(session: zenoh.Session, keys: Keys, timeout_s: float) -> bool:
    """Whether somebody serves a pair of the vehicle, by its liveliness token."""
    held = session.liveliness().get(keys.alive("*"), timeout=timeout_s)
    return any(reply.ok is not None for reply in held)


def nobody(selector: str, *, service_is_there: bool = False) -> NotFoundError:
    """The error for a query that nobody answered. A query that the router's rules forbid is not answered either;
    neither Zenoh nor this function can distinguish the two for certain."""
    if service_is_there:
        return NotFoundError(
            f"no answer to {selector.partition('?')[0]}, though the service is there (its liveliness token is seen): "
            "the router's rules may not allow it to you, or the pair is not one of the vehicle's (`coec query status`)"
        )
    return NotFoundError(
        f"nobody answered {selector.partition('?')[0]}: check that `coec run` is up (it answers a second or two after "
        "its start) and connected to the same router, that vehicle, prefix and pair are right (`coec query status`), "
        "and that the router's rules allow it to you"
    )


def _remote_error(payload: bytes, encoding: str) -> RemoteError:
    read = from_json if encoding.startswith(JSON) else from_msgpack
    try:
        error = read(ErrorReply, payload)
    except DecodeError:
        return RemoteError("unknown", f"an error reply in a form that is not ours ({encoding}, {len(payload)} bytes)")
    return RemoteError(error.code, error.message)
