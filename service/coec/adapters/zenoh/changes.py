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

MAX_BYTES = 2**20
"""Largest document that is read; health with all its figures has some 10 kB."""


MAX_KEYS = 4096
"""Most keys of a vehicle; each pair has three."""


@dataclass(frozen=True, slots=True)
class Change:
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
def listening(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    timeout_s: float,
    take: Callable[[Change], None],
    refuse: Callable[[], None],
) -> Iterator[None]:
    """Inside the block, `take` is called for the current state of a pair (`*`: of each pair) and for every change, and
    `refuse` for every document that cannot be read. Both are called on Zenoh's threads and must not wait. The block
    begins before the answers about the current state are there; they come within `timeout_s` or not at all. A pair that
    appears later is queried, too, because its first words may have been sent before it knew of this subscriber."""
    heard: set[str] = set()
    answers: dict[str, tuple[object, zenoh.Timestamp | None]] = {}
    order = threading.Lock()
    given_up = zenoh.CancellationToken()

    def give(sample: zenoh.Sample) -> bool:
        key = str(sample.key_expr)
        try:
            if key not in heard and len(heard) >= MAX_KEYS:
                raise DecodeError("too_many_keys", f"a vehicle with more than {MAX_KEYS} keys")
            change = _change(sample)
        except DecodeError:
            refuse()
            return False
        heard.add(key)
        take(change)
        return True

    def hear(sample: zenoh.Sample) -> bool:
        with order:
            answers.pop(str(sample.key_expr), None)
            return give(sample)

    def ask(told: Iterable[str]) -> None:
        query = object()

        def answered(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                return
            with order:
                key, stamp = str(reply.ok.key_expr), reply.ok.timestamp
                query_of, before = answers.get(key, (None, None))
                # A change that was heard meanwhile is as new as this answer, or newer. Of several answers to one query
                # the latest counts.
                if (key not in heard or (query_of is query and is_later(stamp, before))) and give(reply.ok):
                    answers[key] = (query, stamp)

        for key in told:
            session.get(
                key,
                zenoh.handlers.Callback(answered, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # else Zenoh keeps all answers until the query ends
                timeout=timeout_s,
                cancellation_token=given_up,
            )

    def come_or_gone(sample: zenoh.Sample) -> None:
        if not hear(sample):
            return
        of_pair = str(sample.key_expr).removesuffix("alive")
        told = (f"{of_pair}health", f"{of_pair}extrinsic")
        if sample.kind == zenoh.SampleKind.PUT:
            ask(told)
        else:
            with order:
                heard.difference_update(told)

    now = (keys.health(pair), keys.extrinsic(pair))
    handler = zenoh.handlers.Callback(hear, indirect=False)
    with ExitStack() as stack:
        for key in now:
            stack.callback(session.declare_subscriber(key, handler).undeclare)
        of_tokens = zenoh.handlers.Callback(come_or_gone, indirect=False)
        tokens = session.liveliness().declare_subscriber(keys.alive(pair), of_tokens, history=True)
        stack.callback(tokens.undeclare)
        stack.callback(given_up.cancel)
        ask(now)
        yield


def _change(sample: zenoh.Sample) -> Change:
    """The change in a sample. Raises DecodeError if it is not a document of this schema."""
    key = str(sample.key_expr)
    _, pair, kind = key.rsplit("/", 2)
    if kind == "alive":
        return Change(key, pair, "alive", sample.kind == zenoh.SampleKind.PUT)
    if len(sample.payload) > MAX_BYTES:
        raise DecodeError("message_too_large", f"a document of more than {MAX_BYTES} bytes")
    read = from_json if str(sample.encoding).startswith(JSON) else from_msgpack
    payload = sample.payload.to_bytes()
    if kind == "health":
        return Change(key, pair, "health", read(HealthReply, payload))
    return Change(key, pair, "extrinsic", read(ExtrinsicReply, payload))
