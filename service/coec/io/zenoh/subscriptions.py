"""What a client receives through a router as it happens: the current extrinsic and health of a vehicle's pairs and
every change, and heartbeats of many vehicles (published, queried, and liveliness tokens).
"""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import zenoh

from coec.errors import DecodeError
from coec.io.zenoh.query_client import JSON, is_later
from coec.schemas.heartbeat import MAX_HEARTBEAT_BYTES
from coec.schemas.keys import Keys
from coec.schemas.message import from_json, from_msgpack
from coec.schemas.replies import ExtrinsicReply, HealthReply

MAX_DOCUMENT_BYTES = 2**20
"""Largest document that is read; health with all its figures has some 10 kB."""


MAX_KEYS = 4096
"""Most keys of a vehicle; each pair has three."""


@dataclass(frozen=True, slots=True)
class PairUpdate:
    """One change of a pair.

    Attributes:
        key: whole key on the bus.
        pair: name of the pair.
        kind: `extrinsic`, `health`, or `alive`: whether the pair is served.
        value: the reply, as a query would give it; True or False for `alive`.
        lost: changes lost before this one: they came faster than they were taken, or could not be read.
    """

    key: str
    pair: str
    kind: Literal["extrinsic", "health", "alive"]
    value: ExtrinsicReply | HealthReply | bool
    lost: int = 0


class _PairDocuments:
    """The newest document of each key, put in one order from changes and from answers to queries."""

    def __init__(
        self,
        session: zenoh.Session,
        timeout_s: float,
        on_update: Callable[[PairUpdate], None],
        on_refused: Callable[[], None],
    ) -> None:
        self._session, self._timeout_s = session, timeout_s
        self._on_update, self._on_refused = on_update, on_refused
        self._known: set[str] = set()
        self._answers: dict[str, tuple[object, zenoh.Timestamp | None]] = {}
        self._order = threading.Lock()
        self._cancelled = zenoh.CancellationToken()

    def on_sample(self, sample: zenoh.Sample) -> bool:
        """A change of a document. Returns whether it was delivered."""
        with self._order:
            self._answers.pop(str(sample.key_expr), None)
            return self._deliver(sample)

    def on_token(self, sample: zenoh.Sample) -> None:
        """A pair appears, and is queried, or disappears."""
        if not self.on_sample(sample):
            return
        of_pair = str(sample.key_expr).removesuffix("alive")
        documents = (f"{of_pair}health", f"{of_pair}extrinsic")
        if sample.kind == zenoh.SampleKind.PUT:
            self.query(documents)
        else:
            with self._order:
                self._known.difference_update(documents)

    def query(self, keys: Iterable[str]) -> None:
        """Queries the current documents; answers are delivered on Zenoh's threads."""
        query_id = object()
        for key in keys:
            self._session.get(
                key,
                zenoh.handlers.Callback(partial(self._on_reply, query_id), indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # else Zenoh keeps all answers until the query ends
                timeout=self._timeout_s,
                cancellation_token=self._cancelled,
            )

    def cancel(self) -> None:
        """Cancels the open queries."""
        self._cancelled.cancel()

    def _on_reply(self, query_id: object, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        with self._order:
            key, stamp = str(reply.ok.key_expr), reply.ok.timestamp
            query_of, before = self._answers.get(key, (None, None))
            # A change that was received meanwhile is as new as this answer, or newer. Of several answers to one query
            # the latest counts.
            is_newest = key not in self._known or (query_of is query_id and is_later(stamp, before))
            if is_newest and self._deliver(reply.ok):
                self._answers[key] = (query_id, stamp)

    def _deliver(self, sample: zenoh.Sample) -> bool:
        key = str(sample.key_expr)
        try:
            if key not in self._known and len(self._known) >= MAX_KEYS:
                raise DecodeError("too_many_keys", f"a vehicle with more than {MAX_KEYS} keys")
            change = _update_in(sample)
        except DecodeError:
            self._on_refused()
            return False
        self._known.add(key)
        self._on_update(change)
        return True


@contextmanager
def subscribed(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    timeout_s: float,
    on_update: Callable[[PairUpdate], None],
    on_refused: Callable[[], None],
) -> Iterator[None]:
    """Inside the block, `on_update` is called for the current state of a pair (`*`: of each pair) and for every change,
    and `on_refused` for every document that cannot be read. Both are called on Zenoh's threads and must not wait. The
    block begins before the answers about the current state are there; they come within `timeout_s` or not at all. A
    pair that appears later is queried, too, because its first documents may have been sent before it knew of this
    subscriber."""
    now = (keys.health(pair), keys.extrinsic(pair))
    documents = _PairDocuments(session, timeout_s, on_update, on_refused)
    handler = zenoh.handlers.Callback(documents.on_sample, indirect=False)
    with ExitStack() as stack:
        for key in now:
            stack.callback(session.declare_subscriber(key, handler).undeclare)
        of_tokens = zenoh.handlers.Callback(documents.on_token, indirect=False)
        tokens = session.liveliness().declare_subscriber(keys.alive(pair), of_tokens, history=True)
        stack.callback(tokens.undeclare)
        stack.callback(documents.cancel)
        documents.query(now)
        yield


def _update_in(sample: zenoh.Sample) -> PairUpdate:
    """The change in a sample. Raises DecodeError if it is not a document of this schema."""
    key = str(sample.key_expr)
    _, pair, kind = key.rsplit("/", 2)
    if kind == "alive":
        return PairUpdate(key, pair, "alive", sample.kind == zenoh.SampleKind.PUT)
    if len(sample.payload) > MAX_DOCUMENT_BYTES:
        raise DecodeError("message_too_large", f"a document of more than {MAX_DOCUMENT_BYTES} bytes")
    read = from_json if str(sample.encoding).startswith(JSON) else from_msgpack
    payload = sample.payload.to_bytes()
    if kind == "health":
        return PairUpdate(key, pair, "health", read(HealthReply, payload))
    return PairUpdate(key, pair, "extrinsic", read(ExtrinsicReply, payload))


MAX_WAITING: Final = 32_768
"""Most words that wait to be read, 1 kB each: enough for a fleet that answers all at once. Words beyond this are
counted as lost, and repeated by their pairs within a period."""

MAX_WAITING_BYTES: Final = 2**26
"""Most bytes of all these words together, because a word may have 16 kB: twice what as many usual words have."""


@dataclass(frozen=True, slots=True)
class HeartbeatEvent:
    """One received thing: a word as it was published (`said`), a word from a query (`kept`), or a token. `at_s` is by
    the steady clock. The payload of a token is empty if the token was withdrawn."""

    kind: Literal["said", "kept", "token"]
    key: str
    payload: bytes
    at_s: float


class HeartbeatReceiver:
    """Last words of the vehicles that an expression names. Callbacks run on Zenoh's threads and do not wait."""

    def __init__(self, session: zenoh.Session, of_tokens: zenoh.Session, keys: Keys, timeout_s: float) -> None:
        """`keys.vehicle` may be `*`. Tokens need a separate session: each stays in the session's tables, and every word
        that came in the same session would be matched against them (1 ms of processor per word with 10,000
        vehicles)."""
        self._session = session
        self._of_tokens = of_tokens
        self._keys = keys
        self._timeout_s = timeout_s
        self._waiting: queue.Queue[HeartbeatEvent] = queue.Queue(MAX_WAITING)
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._refused: Counter[str] = Counter()
        self.initial_query_done = threading.Event()
        """Set when everybody has answered the query at the beginning, or its time is up."""

    def pending(self) -> Iterator[HeartbeatEvent]:
        """The words and tokens that wait, at most `WAITING`."""
        for _ in range(MAX_WAITING):
            try:
                received = self._waiting.get_nowait()
            except queue.Empty:
                return
            with self._lock:
                self._waiting_bytes -= len(received.payload)
            yield received

    def refused(self) -> Counter[str]:
        """Number of words lost or refused since the last call, by cause."""
        with self._lock:
            refused, self._refused = self._refused, Counter()
        return refused

    def query(self, vehicle: str, pair: str) -> None:
        """Query the word of one pair from whoever has it; the answer comes as `kept`."""
        self._get(Keys(self._keys.prefix, vehicle).last(pair), threading.Event())

    @property
    def is_connected(self) -> bool:
        """Whether the session is connected to a router now."""
        return bool(list(self._session.info.routers_zid()))

    # --- inside -----------------------------------------------------------------------------------------------------

    @contextmanager
    def subscribed(self) -> Iterator[None]:
        """Inside the block: receive published words and tokens, and query once for earlier words."""
        with ExitStack() as stack:
            on_published = zenoh.handlers.Callback(self._on_published, indirect=False)
            stack.callback(self._session.declare_subscriber(self._keys.last("*"), on_published).undeclare)
            token = zenoh.handlers.Callback(self._on_token, indirect=False)
            tokens = self._of_tokens.liveliness().declare_subscriber(self._keys.alive("*"), token, history=True)
            stack.callback(tokens.undeclare)
            self._get(self._keys.last("*"), self.initial_query_done)
            yield

    def _get(self, key: str, done: threading.Event) -> None:
        handler = zenoh.handlers.Callback(self._on_reply, done.set, indirect=False)
        # Any other mode of consolidation keeps all words in Zenoh until the query ends. The roster takes the latest.
        of_all, none = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
        self._session.get(key, handler, target=of_all, consolidation=none, timeout=self._timeout_s)

    def _on_published(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._put("said", str(sample.key_expr), sample.payload)

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._put("kept", str(reply.ok.key_expr), reply.ok.payload)

    def _on_token(self, sample: zenoh.Sample) -> None:
        there = b"\x01" if sample.kind == zenoh.SampleKind.PUT else b""
        self._add(HeartbeatEvent("token", str(sample.key_expr), there, time.monotonic()))

    def _put(self, kind: Literal["said", "kept"], key: str, payload: zenoh.ZBytes) -> None:
        if len(payload) > MAX_HEARTBEAT_BYTES:
            self._refuse("word_too_large")
            return
        with self._lock:
            is_full = self._waiting_bytes + len(payload) > MAX_WAITING_BYTES
        if is_full:
            self._refuse("too_many_at_once")
            return
        self._add(HeartbeatEvent(kind, key, payload.to_bytes(), time.monotonic()))

    def _add(self, event: HeartbeatEvent) -> None:
        with self._lock:
            self._waiting_bytes += len(event.payload)
        try:
            self._waiting.put_nowait(event)
        except queue.Full:
            with self._lock:
                self._waiting_bytes -= len(event.payload)
            self._refuse("too_many_at_once")

    def _refuse(self, cause: str) -> None:
        with self._lock:
            self._refused[cause] += 1
