"""Receives the last words of many vehicles through a router: published words, queried words, and liveliness tokens."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final, Literal

import zenoh

from coec.schemas.keys import Keys
from coec.schemas.last_word import MAX_HEARTBEAT_BYTES

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
