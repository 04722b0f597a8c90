"""The current extrinsic and health of a vehicle's pairs, and every change from then on, received through a router."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Literal

import zenoh

from coec.adapters.zenoh.client import JSON, is_later
from coec.errors import DecodeError
from coec.schemas.base import from_json, from_msgpack
from coec.schemas.keys import Keys
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


@contextmanager
def subscribed(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    timeout_s: float,
    on_update: Callable[[PairUpdate], None],
    on_refused: Callable[[], None],
) -> Iterator[None]:
    """Inside the block, `take` is called for the current state of a pair (`*`: of each pair) and for every change, and
    `refuse` for every document that cannot be read. Both are called on Zenoh's threads and must not wait. The block
    begins before the answers about the current state are there; they come within `timeout_s` or not at all. A pair that
    appears later is queried, too, because its first words may have been sent before it knew of this subscriber."""
    known: set[str] = set()
    answers: dict[str, tuple[object, zenoh.Timestamp | None]] = {}
    order = threading.Lock()
    cancelled = zenoh.CancellationToken()

    def deliver(sample: zenoh.Sample) -> bool:
        key = str(sample.key_expr)
        try:
            if key not in known and len(known) >= MAX_KEYS:
                raise DecodeError("too_many_keys", f"a vehicle with more than {MAX_KEYS} keys")
            change = _update_in(sample)
        except DecodeError:
            on_refused()
            return False
        known.add(key)
        on_update(change)
        return True

    def on_sample(sample: zenoh.Sample) -> bool:
        with order:
            answers.pop(str(sample.key_expr), None)
            return deliver(sample)

    def request(requested: Iterable[str]) -> None:
        query_id = object()

        def answered(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                return
            with order:
                key, stamp = str(reply.ok.key_expr), reply.ok.timestamp
                query_of, before = answers.get(key, (None, None))
                # A change that was heard meanwhile is as new as this answer, or newer. Of several answers to one query
                # the latest counts.
                if (key not in known or (query_of is query_id and is_later(stamp, before))) and deliver(reply.ok):
                    answers[key] = (query_id, stamp)

        for key in requested:
            session.get(
                key,
                zenoh.handlers.Callback(answered, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # else Zenoh keeps all answers until the query ends
                timeout=timeout_s,
                cancellation_token=cancelled,
            )

    def on_token(sample: zenoh.Sample) -> None:
        if not on_sample(sample):
            return
        of_pair = str(sample.key_expr).removesuffix("alive")
        documents = (f"{of_pair}health", f"{of_pair}extrinsic")
        if sample.kind == zenoh.SampleKind.PUT:
            request(documents)
        else:
            with order:
                known.difference_update(documents)

    now = (keys.health(pair), keys.extrinsic(pair))
    handler = zenoh.handlers.Callback(on_sample, indirect=False)
    with ExitStack() as stack:
        for key in now:
            stack.callback(session.declare_subscriber(key, handler).undeclare)
        of_tokens = zenoh.handlers.Callback(on_token, indirect=False)
        tokens = session.liveliness().declare_subscriber(keys.alive(pair), of_tokens, history=True)
        stack.callback(tokens.undeclare)
        stack.callback(cancelled.cancel)
        request(now)
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
