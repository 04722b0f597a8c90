"""The client end of the bus: a session that queries and publishes, for the command line, programs and tests; commands
whose sender and service authenticate each other; and recorded windows, fetched over slow or broken links: piece by
piece, resumed after a break, verified at the end.

The received part lies beside the final file, under a name that holds the expected sha256. A later attempt, even by
another process on another day, goes on from there, and pieces of two versions of a window never mix in one file.
"""

import getpass
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import zenoh

from coec.errors import (
    CoecError,
    ConnectionFailedError,
    DecodeError,
    NotFoundError,
    NotProvenError,
    OutputError,
    RemoteError,
    UsageError,
)
from coec.io import storage
from coec.io.user_files import require_absent
from coec.io.zenoh.command_auth import CommandSender
from coec.io.zenoh.session import check_certificates, open_client, read_settings, redacted
from coec.schemas.commands import ProvenCommand
from coec.schemas.keys import MAX_COMMAND_TIMEOUT_MS, MAX_LENGTH, Keys
from coec.schemas.message import from_json, from_msgpack, to_json
from coec.schemas.replies import ErrorReply, SnippetInfo, WindowInfo, WindowsReply

JSON, MSGPACK = "application/json", "application/msgpack"
ENDPOINT = re.compile(r"[a-z0-9-]+/[^\s/].*")
"""PROTOCOL/ADDRESS, as Zenoh writes it."""

ON_SITE = 0.9
"""Share of the client's waiting time that the service may take for a command; the rest is for the way there and
back."""

TIMEOUT_PAYLOAD = b"Timeout"
"""Zenoh's own reply if nobody finished the query in time."""

GRACE_S = 1.0
"""Waited beyond the timeout of a query, s. Zenoh ends the query at the timeout, unless its session hangs."""

MAX_MESSAGE_BYTES = 2 * MAX_LENGTH
"""Largest message that a client accepts, bytes: as much as a service and the shipped router accept by default. Zenoh's
own default is a gigabyte. It drops a larger message while that comes in, and says nothing about it."""

MAX_ERROR_BYTES = 2**16
"""Largest error reply that is read; ours have some hundred bytes."""

MAX_SHOWN_KEY = 160
"""Most characters of a key that an error shows, since a sender chose it."""


@dataclass(frozen=True, slots=True)
class ReplyBounds:
    """Most that the replies to one query may bring. Anybody whom the router lets answer may send any number of replies
    of any size.

    Attributes:
        replies: number of replies.
        total_bytes: bytes of all replies together.
        reply_bytes: bytes of one reply.
    """

    replies: int
    total_bytes: int
    reply_bytes: int = MAX_MESSAGE_BYTES


OF_ONE_KEY = ReplyBounds(16, MAX_MESSAGE_BYTES)
"""Of a query for one key. One program answers, or two while a storage keeps last words; more than some are no service
of ours."""

OF_MANY_KEYS = ReplyBounds(4096, 2 * MAX_MESSAGE_BYTES)
"""Of a query for many keys: as many replies as `watch` follows keys. The history of 32 pairs has 20 MB at its default
length."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer; `encoding` is the sender's description of the payload."""

    key: str
    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class RouterAddress:
    """How to reach a router: at the first of the endpoints that answers, with the session settings of a file (Zenoh
    configuration, JSON5; None: default settings)."""

    endpoints: tuple[str, ...]
    file: Path | None = None


@contextmanager
def connected(endpoints: Sequence[str], wait_s: float) -> Iterator[zenoh.Session]:
    """As `connected_by`, with endpoints and default settings."""
    with connected_by(RouterAddress(tuple(endpoints)), wait_s) as session:
        yield session


@contextmanager
def connected_by(
    router: RouterAddress, wait_s: float, max_message_bytes: int = MAX_MESSAGE_BYTES
) -> Iterator[zenoh.Session]:
    """A client session with the first router that answers, closed at the end. `max_message_bytes` is the largest
    message that it receives, whatever the file says.

    Raises:
        UsageError: an endpoint is malformed.
        ConfigError: the file, or a certificate that it names, cannot be used.
        ConnectionFailedError: no router answered within `wait_s`.
    """
    settings = zenoh.Config() if router.file is None else read_settings(router.file)
    for endpoint in router.endpoints:
        if not ENDPOINT.fullmatch(endpoint):
            raise UsageError(
                f"{redacted(endpoint)!r} is not a router endpoint: write PROTOCOL/ADDRESS, as tcp/127.0.0.1:7447"
            )
    zenoh.init_log_from_env_or("off")
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("listen/endpoints", "[]")
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("transport/link/rx/max_message_size", str(max_message_bytes))
    # Publishers that keep their last message for late subscribers need timestamps.
    settings.insert_json5("timestamping/enabled", "true")
    try:
        settings.insert_json5("connect/endpoints", json.dumps(router.endpoints))
        check_certificates(settings, str(router.file or "--connect"))
        session = open_client(settings, wait_s)
    except (zenoh.ZError, ValueError) as error:
        tried = ", ".join(redacted(endpoint) for endpoint in router.endpoints)
        by_certificate = any(endpoint.startswith(("tls/", "quic/")) for endpoint in router.endpoints)
        refused = ", or it refuses the certificate (`openssl x509 -in FILE -noout -subject -issuer -dates`)"
        raise ConnectionFailedError(
            f"no Zenoh router answered at {tried} within {wait_s:g} s{refused if by_certificate else ''}: start one, "
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


def query_all(
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
        RemoteError: as `Replies.result`.
    """
    finished = threading.Event()
    replies = Replies(selector, timeout_s, finished.set)
    try:
        replies.query(session, payload, attachment)
        in_time = finished.wait(timeout_s + GRACE_S)
    finally:
        replies.close()
    if not in_time:
        raise too_late(selector, timeout_s)
    return replies.result()


def query_target(selector: str) -> zenoh.QueryTarget:
    """Which queryables are asked: the nearest complete one for a key, all of them for a key expression.

    Raises:
        UsageError: the selector does not begin with a key expression.
    """
    key = key_expression(selector.partition("?")[0])
    return zenoh.QueryTarget.ALL if "*" in key else zenoh.QueryTarget.BEST_MATCHING


class Replies:
    """The replies to one query, within bounds. Zenoh's threads add them, one thread queries and takes the result.

    Replies are copied as they come and Zenoh keeps none, so that no more memory is used than the bounds allow. At the
    first error reply, or beyond a bound, the query ends at once. Of several replies with the same key, the one with the
    latest timestamp counts.
    """

    def __init__(
        self, selector: str, timeout_s: float, on_finished: Callable[[], None], bounds: ReplyBounds | None = None
    ) -> None:
        """`on_finished` is called on Zenoh's thread when no more replies are needed. `bounds` None: by whether the
        selector stands for one key.

        Raises:
            UsageError: the selector does not begin with a key expression.
        """
        self._selector = selector
        self._timeout_s = timeout_s
        self._on_finished = on_finished
        self._target = query_target(selector)
        self._key = selector.partition("?")[0]
        self._bounds = bounds or (OF_MANY_KEYS if "*" in self._key else OF_ONE_KEY)
        self._given_up = zenoh.CancellationToken()
        self._replies: dict[str, tuple[Reply, zenoh.Timestamp | None]] = {}
        self._received = self._bytes = 0
        self._timed_out = False
        self._error: RemoteError | None = None

    def query(self, session: zenoh.Session, payload: bytes | None = None, attachment: bytes | None = None) -> None:
        """Sends the query and returns at once."""
        session.get(
            self._selector,
            zenoh.handlers.Callback(self.add, self._on_finished, indirect=False),
            target=self._target,
            # Any other mode keeps all replies in Zenoh until the query ends.
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._timeout_s,
            payload=payload,
            encoding=JSON if payload is not None else None,
            attachment=attachment,
            cancellation_token=self._given_up,
        )

    def close(self) -> None:
        """Ends the query; further replies are dropped."""
        self._given_up.cancel()

    def add(self, reply: zenoh.Reply) -> None:
        """Takes the next reply, on Zenoh's thread."""
        if self._error is not None:
            return
        self._error = self._refusal(reply) if reply.ok is None else self._excess(reply.ok)
        if self._error is not None:
            self._on_finished()
        elif reply.ok is not None:
            self._store(reply.ok)

    def result(self) -> list[Reply]:
        """The replies, in the order of their keys.

        Raises:
            RemoteError: somebody replied with an error, or with more than the bounds allow, or somebody timed out and
                nobody else answered.
        """
        if self._error is not None:
            raise self._error
        if self._timed_out and not self._replies:
            raise too_late(self._selector, self._timeout_s)
        return [self._replies[key][0] for key in sorted(self._replies)]

    def _store(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        before = self._replies.get(key)
        if before is not None:
            if not is_later(sample.timestamp, before[1]):
                return
            self._bytes -= len(before[0].payload)
        payload = sample.payload.to_bytes()
        self._bytes += len(payload)
        self._replies[key] = (Reply(key, payload, str(sample.encoding)), sample.timestamp)

    def _refusal(self, reply: zenoh.Reply) -> RemoteError | None:
        """The error in an error reply; None if it only says that the time is up."""
        assert reply.err is not None
        if len(reply.err.payload) > MAX_ERROR_BYTES:
            return RemoteError("unknown", f"an error reply of {len(reply.err.payload)} bytes: it is not ours")
        content = reply.err.payload.to_bytes()
        if content == TIMEOUT_PAYLOAD:
            self._timed_out = True
            return None
        return _remote_error(content, str(reply.err.encoding))

    def _excess(self, sample: zenoh.Sample) -> RemoteError | None:
        """The error if this reply exceeds a bound; None if it does not."""
        bounds, size = self._bounds, len(sample.payload)
        self._received += 1
        advice = "name one vehicle and one pair instead of `*`"
        if "*" not in self._key:
            advice = "one program answers for a key: find the others, and see the router's rules (docs/security.md)"
        if self._received > bounds.replies:
            text = f"more than {bounds.replies} replies to {self._key}, the rest was left out: {advice}"
            return RemoteError("too_many_replies", text)
        if size > bounds.reply_bytes:
            key = f"{str(sample.key_expr)[:MAX_SHOWN_KEY]!a}"
            text = f"the reply of {key} has {size} bytes, and {bounds.reply_bytes} are accepted: ask for less of it"
            return RemoteError("reply_too_large", f"{text} (history: --param limit=N), or find out what answers there")
        if self._bytes + size > bounds.total_bytes:
            text = (
                f"the replies to {self._key} have more than {bounds.total_bytes} bytes after {self._received} replies"
            )
            return RemoteError("replies_too_large", f"{text}, the rest was left out: {advice}")
        return None


def is_later(timestamp: zenoh.Timestamp | None, before: zenoh.Timestamp | None) -> bool:
    """Whether a reply with this timestamp replaces one with the timestamp `before`; None: a reply without one."""
    return timestamp is not None and (before is None or timestamp.get_time() > before.get_time())


def too_late(selector: str, timeout_s: float) -> RemoteError:
    """The error for a query that somebody received but did not answer in time."""
    text = f"no answer to {selector} within {timeout_s:g} s: the service is too busy; try again, or wait longer"
    return RemoteError("timeout", f"{text} (--timeout SECONDS, timeout_s)")


def myself() -> bytes:
    """The name that a sender gives with a command, for the log and for a rate limit per sender. It proves nothing."""
    with suppress(OSError, KeyError):  # a user without a name
        return f"{getpass.getuser()}@{socket.gethostname()}".encode("ascii", errors="replace")
    return socket.gethostname().encode("ascii", errors="replace")


def patience_ms(timeout_s: float) -> int:
    """Time within which the service must begin a command, ms, if the client waits `timeout_s` for the acknowledgement;
    later the service does not carry it out."""
    return min(max(round(timeout_s * 1e3 * ON_SITE), 1), MAX_COMMAND_TIMEOUT_MS)


def query_one(session: zenoh.Session, selector: str, timeout_s: float, payload: bytes | None = None) -> Reply:
    """The answer to a query for one key, the first if there are several.

    Raises:
        NotFoundError: nobody answered; says what to check.
        RemoteError: as `ask`.
    """
    replies = query_all(session, selector, timeout_s, payload)
    if not replies:
        raise no_reply_error(selector)
    return replies[0]


def is_alive(session: zenoh.Session, keys: Keys, timeout_s: float) -> bool:
    """Whether somebody serves a pair of the vehicle, by its liveliness token."""
    held, finished, given_up = threading.Event(), threading.Event(), zenoh.CancellationToken()

    def add(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            held.set()
            finished.set()

    handler = zenoh.handlers.Callback(add, finished.set, indirect=False)
    session.liveliness().get(keys.alive("*"), handler, timeout=timeout_s, cancellation_token=given_up)
    finished.wait(timeout_s + GRACE_S)
    given_up.cancel()  # however many tokens there are, the first one says it
    return held.is_set()


def no_reply_error(selector: str, *, service_is_there: bool = False) -> NotFoundError:
    """The error for a query that nobody answered. A query that the router's rules forbid is not answered either;
    neither Zenoh nor this function can distinguish the two for certain."""
    if service_is_there:
        return NotFoundError(
            f"no answer to {selector.partition('?')[0]}, though the service is there (its liveliness token is seen): "
            "the router's rules may not allow it to you, the pair is not one of the vehicle's (`coec query status`), "
            f"or the answer has more than {MAX_MESSAGE_BYTES} bytes: ask for less"
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


BUSY_CODE = "busy"
"""Code of an error reply: too many queries wait."""

BUSY_PAUSE_S = 0.05
"""Pause before asking a busy service again; in about that time it works off a full queue of conversations that
begin."""


def send_authenticated(
    session: zenoh.Session,
    selector: str,
    payload: bytes | None,
    timeout_s: float,
    speaker: CommandSender,
    encoding: str,
) -> Reply:
    """Gives a command and returns its acknowledgement, which is proven to come from the service.

    Args:
        selector: key and parameters of the command, as without proof.
        encoding: of the acknowledgement, as the parameters ask for it.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: an error reply. It carries no proof, because a router in between can always refuse.
        NotProvenError: the answer does not come from the service.
    """
    key = selector.partition("?")[0]
    conversation = f"{key}?tls={secrets.token_hex(16)};format=json"
    flight = _exchange(session, conversation, timeout_s, speaker.first_flight())
    command = ProvenCommand(selector=selector, payload=(payload or b"").decode())
    sealed = _exchange(session, conversation, timeout_s, speaker.send(flight, to_json(command)))
    answer = speaker.reply(sealed)
    if not answer:
        raise NotProvenError("the service aborted the TLS session")
    return Reply(key, answer, encoding)


def _exchange(session: zenoh.Session, conversation: str, timeout_s: float, outgoing: bytes) -> bytes:
    """The answer to the next bytes. If the service is busy, they are sent again. This is safe even if somebody else
    replied "busy", because the service completes a conversation only once, so that nothing is done twice."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            return query_one(session, conversation, timeout_s, outgoing).payload
        except RemoteError as error:
            if error.reply_code != BUSY_CODE or time.monotonic() + BUSY_PAUSE_S > deadline_s:
                raise
        time.sleep(BUSY_PAUSE_S)


# --- recorded windows -------------------------------------------------------------------------------------------------

PIECE_BYTES: Final = 2**19
"""Size of a piece: half a second at the rate at which a vehicle sends by default. A broken link loses one piece."""

MAX_WINDOW_BYTES: Final = 2**32
"""Largest window that is fetched: as much as a vehicle keeps of all windows by default (`state.max_bytes`)."""

SPARE_BYTES: Final = 2**28
"""Room that a fetched window must leave on the disk, for what else is written there meanwhile."""

DIGEST_POLL_S: Final = 0.2
"""Pause between queries whether the service has read a window; its recorder looks for windows as often."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""Pause before a piece is asked for again, doubled each time up to the longest."""

RETRIED_CODES: Final = frozenset({"uplink_busy", "busy", "timeout"})
"""Reply codes after which it makes sense to send the same query again."""

SHA256: Final = re.compile(r"[0-9a-f]{64}")
"""Form of a hash in the list, checked because a part of the hash becomes part of a file name."""

BLOCK_BYTES: Final = 2**20
"""Bytes of the part that is already there to read and hash at a time."""


RecordingInfo = WindowInfo | SnippetInfo


class NoSpaceError(CoecError):
    """The disk has no room for a window that is to be fetched."""

    reply_code = "no_room"


def fetch_window(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    window_id: str,
    path: Path,
    timeout_s: float,
    patience_s: float,
    on_progress: Callable[[int, int], None],
    max_bytes: int = MAX_WINDOW_BYTES,
    *,
    replaces: bool = True,
) -> RecordingInfo:
    """Fetches a window or snippet into a file, which gets its final name only if its sha256 is right.

    If the service rewrites the window meanwhile (because its result came), it is fetched once more. A file that is
    already complete is not fetched.

    Args:
        timeout_s: for one answer.
        patience_s: time without any new piece after which to give up.
        on_progress: called with the number of bytes that are there, and the total.
        max_bytes: largest size that the vehicle may claim; nothing is fetched of a larger one.
        replaces: whether a file of another content may be replaced. An earlier version of the window is one.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: there is no such window, it is larger than `max_bytes`, or its bytes do not have the promised hash.
        NoSpaceError: the disk has no room for it.
        OutputError: the file cannot be written. The received part stays for the next attempt. Or it holds something
            else, and must not be replaced.
    """
    info = _digested(session, keys, pair, window_id, timeout_s)
    for attempt in (1, 2):
        if info.sha256 is None or not SHA256.fullmatch(info.sha256):
            raise RemoteError("malformed", f"the list does not say which sha256 window {window_id} has")
        if not 0 <= info.size_bytes <= max_bytes:
            text = f"window {window_id} is said to have {info.size_bytes} bytes, and {max_bytes} may be fetched"
            raise RemoteError("too_large", f"{text}: nothing of it was")
        try:
            if _is_complete(path, info):
                on_progress(info.size_bytes, info.size_bytes)
                return info
            require_absent(path, force=replaces)
            part = path.with_name(f"{path.name}.{info.sha256[:16]}.part")
            _require_space(part, info, window_id)
            if _complete(session, keys.window(pair, window_id), info, part, timeout_s, patience_s, on_progress):
                part.replace(path)
                return info
            part.unlink()
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        renewed = _digested(session, keys, pair, window_id, timeout_s)
        if attempt == 2 or renewed.sha256 == info.sha256:
            break
        info = renewed
    raise RemoteError("checksum", f"the bytes of window {window_id} do not have the sha256 of the list; try again")


def _complete(
    session: zenoh.Session,
    key: str,
    info: RecordingInfo,
    part: Path,
    timeout_s: float,
    patience_s: float,
    on_progress: Callable[[int, int], None],
) -> bool:
    """Completes the part that is there; False if the result does not have the promised hash."""
    with os.fdopen(storage.reopen(part), "a+b") as file:
        if file.tell() > info.size_bytes:
            file.truncate(0)
        file.seek(0)
        digest, done = hashlib.sha256(), 0
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
            done += len(block)
        on_progress(done, info.size_bytes)
        while done < info.size_bytes:
            length = min(PIECE_BYTES, info.size_bytes - done)
            piece = _piece(session, f"{key}?offset={done};length={length}", timeout_s, patience_s)
            if len(piece) != length:
                return False
            file.write(piece)
            digest.update(piece)
            done += len(piece)
            on_progress(done, info.size_bytes)
    return digest.hexdigest() == info.sha256


def _require_space(part: Path, info: RecordingInfo, window_id: str) -> None:
    part.parent.mkdir(parents=True, exist_ok=True)
    missing = info.size_bytes - (part.stat().st_size if part.exists() else 0)
    free = shutil.disk_usage(part.parent).free
    if missing + SPARE_BYTES > free:
        raise NoSpaceError(
            f"no room for window {window_id} in {part.parent}: {missing} bytes are to be fetched, {free} are free, and "
            f"{SPARE_BYTES} of these stay free; make room, or name another place with --output"
        )


def _piece(session: zenoh.Session, selector: str, timeout_s: float, patience_s: float) -> bytes:
    deadline_s, pause_s = time.monotonic() + patience_s, FIRST_PAUSE_S
    while True:
        try:
            return query_one(session, selector, timeout_s).payload
        except CoecError as error:
            again = isinstance(error, NotFoundError) or error.reply_code in RETRIED_CODES
            if not again or time.monotonic() + pause_s > deadline_s:
                raise
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)


def _is_complete(path: Path, info: RecordingInfo) -> bool:
    if not path.is_file() or path.stat().st_size != info.size_bytes:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == info.sha256


def _digested(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> RecordingInfo:
    """The entry of a window in the service's list, once the service has read the window and knows its hash."""
    deadline_s = time.monotonic() + timeout_s
    while (info := _info(session, keys, pair, window_id, timeout_s)).sha256 is None:
        if time.monotonic() > deadline_s:
            text = f"the service has not read window {window_id} since its start: try again in a minute"
            raise RemoteError("checksum", text)
        time.sleep(DIGEST_POLL_S)
    return info


def _info(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> RecordingInfo:
    reply = from_json(WindowsReply, query_one(session, f"{keys.windows(pair)}?format=json", timeout_s).payload)
    recorded: dict[str, RecordingInfo] = {
        **{info.window_id: info for info in reply.windows},
        **{info.snippet_id: info for info in reply.snippets},
    }
    if window_id in recorded:
        return recorded[window_id]
    raise RemoteError("not_found", f"pair {pair} has no window {window_id}: see `coec query windows`")
