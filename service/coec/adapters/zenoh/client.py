"""The other end of the bus: a session that asks and publishes, for commands and tests."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from coec.errors import CoecError, DecodeError, NotFoundError
from coec.schemas.base import from_json, from_msgpack
from coec.schemas.replies import ErrorReply

JSON = "application/json"
TIMEOUT_PAYLOAD = b"Timeout"
"""What Zenoh itself replies with when nobody finished the query in time."""


class ConnectionFailedError(CoecError):
    """There is no router to connect to."""

    reply_code = "not_connected"


class RemoteError(CoecError):
    """An error reply. `code` is the sender's."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.reply_code = code


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer; `encoding` is what its sender says of the payload."""

    key: str
    payload: bytes
    encoding: str


@contextmanager
def connected(endpoints: Sequence[str], wait_s: float) -> Iterator[zenoh.Session]:
    """A client session on the first of the routers that answers, closed at the end.

    Raises:
        ConnectionFailedError: none answered within `wait_s`, or an endpoint is malformed.
    """
    zenoh.init_log_from_env_or("off")
    settings = zenoh.Config()
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("connect/timeout_ms", str(round(wait_s * 1000)))
    settings.insert_json5("connect/exit_on_failure", "true")
    try:
        settings.insert_json5("connect/endpoints", json.dumps(list(endpoints)))
        session = zenoh.open(settings)
    except (zenoh.ZError, ValueError) as error:
        raise ConnectionFailedError(
            f"no Zenoh router answered at {', '.join(endpoints)} within {wait_s:g} s: start one, start `coec run "
            "--embedded-router`, or name the endpoint with --connect"
        ) from error
    try:
        yield session
    finally:
        session.close()


def ask(session: zenoh.Session, selector: str, timeout_s: float, payload: bytes | None = None) -> list[Reply]:
    """Every answer to a query, in the order of their keys; none is an empty list.

    Raises:
        RemoteError: somebody replied with an error, or did not answer within `timeout_s` and nobody else did.
    """
    # The nearest complete queryable answers for a key; a key expression is meant for all of them.
    target = zenoh.QueryTarget.ALL if "*" in selector.partition("?")[0] else zenoh.QueryTarget.BEST_MATCHING
    encoding = JSON if payload is not None else None
    replies: list[Reply] = []
    timed_out = False
    for reply in session.get(selector, target=target, timeout=timeout_s, payload=payload, encoding=encoding):
        if reply.ok is not None:
            sample = reply.ok
            replies.append(Reply(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))
        elif reply.err is not None:
            content = reply.err.payload.to_bytes()
            if content != TIMEOUT_PAYLOAD:
                raise _remote_error(content, str(reply.err.encoding))
            timed_out = True
    if timed_out and not replies:
        raise RemoteError("timeout", f"no answer to {selector} within {timeout_s:g} s: the service is too busy")
    return sorted(replies, key=lambda reply: reply.key)


def ask_one(session: zenoh.Session, selector: str, timeout_s: float, payload: bytes | None = None) -> Reply:
    """The answer to a query for one key.

    Raises:
        NotFoundError: nobody answered; says what to check.
        RemoteError: as `ask`.
    """
    replies = ask(session, selector, timeout_s, payload)
    if not replies:
        raise nobody(selector)
    return replies[0]


def nobody(selector: str) -> NotFoundError:
    """The error of a query that nobody answered."""
    return NotFoundError(
        f"nobody answered {selector.partition('?')[0]}: check that `coec run` is up and connected to the same router, "
        "that vehicle, prefix and pair are right (`coec query status`), and that access control lets you ask"
    )


def _remote_error(payload: bytes, encoding: str) -> RemoteError:
    read = from_json if encoding.startswith(JSON) else from_msgpack
    try:
        error = read(ErrorReply, payload)
    except DecodeError:
        return RemoteError("unknown", f"an error reply in a form that is not ours ({encoding}, {len(payload)} bytes)")
    return RemoteError(error.code, error.message)
