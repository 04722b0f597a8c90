"""A stand-in for a storage of Zenoh's storage manager, whose plugins do not load into the sessions of Python.

It does what its documentation promises of a storage in memory: takes every put and delete below its key expression that
is newer than what it has, and answers queries with what it kept, under the keys and with the timestamps it came with.
What it is told of a storage is what stands in the shipped configuration.
"""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

import zenoh


class MemoryStorage:
    """In a session, while the block lasts."""

    def __init__(self, session: zenoh.Session, key_expr: str, *, complete: bool = True) -> None:
        self._lock = threading.Lock()
        self.samples: dict[str, zenoh.Sample] = {}
        self._subscriber = session.declare_subscriber(key_expr, zenoh.handlers.Callback(self._store, indirect=False))
        handler = zenoh.handlers.Callback(self._answer, indirect=False)
        self._queryable = session.declare_queryable(key_expr, handler, complete=complete)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._subscriber.undeclare()
        self._queryable.undeclare()

    def _store(self, sample: zenoh.Sample) -> None:
        with self._lock:
            key = str(sample.key_expr)
            known = self.samples.get(key)
            before = None if known is None else known.timestamp
            if before is not None and sample.timestamp is not None and sample.timestamp <= before:
                return
            if sample.kind == zenoh.SampleKind.PUT:
                self.samples[key] = sample
            else:
                self.samples.pop(key, None)

    def _answer(self, query: zenoh.Query) -> None:
        with query, self._lock:
            for key, sample in self.samples.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, sample.payload, encoding=sample.encoding, timestamp=sample.timestamp)
