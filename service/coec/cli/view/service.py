"""What a running service says about a pair: on every change, and every two seconds, so that silence is noticed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import zenoh

from coec.adapters.files.conversions import matrix_of
from coec.calibration.types import Matrix4
from coec.cli.view.moments import Said
from coec.errors import DecodeError
from coec.geometry.se3 import is_rigid
from coec.schemas.base import from_msgpack
from coec.schemas.keys import Keys
from coec.schemas.replies import ExtrinsicReply, HealthReply, Transform

T = TypeVar("T")

ASK_S = 2.0
"""Time between two queries, and the timeout of an answer."""

MAX_BYTES = 2**20
"""Most bytes of a document of the service; they have some 10 kB."""

WAITING = 64
"""Documents that may wait to be read, of at most `MAX_BYTES` each; the oldest are dropped."""

HEALTH, EXTRINSIC = "health", "extrinsic"


@dataclass(frozen=True, slots=True)
class _Heard:
    """A document that came: its kind, when it was requested (steady clock; None: it was published), when it came, and
    its bytes (None: it is larger than any of ours)."""

    kind: str
    asked_s: float | None
    came_s: float
    payload: bytes | None


class ServiceWatch:
    """What is known about one pair. One thread uses it; Zenoh's threads only store what came."""

    def __init__(self, session: zenoh.Session, keys: Keys, pair: str, refused: Callable[[str], None]) -> None:
        """`refused` is called with the cause for each document that cannot be read."""
        self._session = session
        self._keys = {HEALTH: keys.health(pair), EXTRINSIC: keys.extrinsic(pair)}
        self._alive_key = keys.alive(pair)
        self._refused = refused
        self._heard: deque[_Heard] = deque(maxlen=WAITING)
        self._alive = False
        self._asked_s = float("-inf")
        self._published_s = dict.fromkeys(self._keys, float("-inf"))
        self._answered_s: float | None = None
        self._health: HealthReply | None = None
        self._extrinsic: ExtrinsicReply | None = None
        self._served: Matrix4 | None = None
        self._candidate: Matrix4 | None = None

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Subscribe to changes, and to whether a service serves the pair."""
        subscribers = [
            self._session.declare_subscriber(key, _directly(self._listener(kind, None)))
            for kind, key in self._keys.items()
        ]
        token = self._session.liveliness().declare_subscriber(
            self._alive_key, _directly(self._hear_of_life), history=True
        )
        try:
            yield
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()
            token.undeclare()

    def look(self) -> Said:
        """What the service said last; asks again when it is time to."""
        now_s = time.monotonic()
        if now_s - self._asked_s >= ASK_S:
            self._asked_s = now_s
            for kind, key in self._keys.items():
                handler = _directly(self._replies(self._listener(kind, now_s)))
                # Any other mode of consolidation keeps the answers in Zenoh until the query ends.
                self._session.get(key, handler, consolidation=zenoh.ConsolidationMode.NONE, timeout=ASK_S)
        while self._heard:
            self._take(self._heard.popleft())
        return Said(
            alive=self._alive,
            answer_age_s=None if self._answered_s is None else now_s - min(self._answered_s, now_s),
            health=self._health,
            extrinsic=self._extrinsic,
            served=self._served,
            candidate=self._candidate,
        )

    def _take(self, heard: _Heard) -> None:
        if heard.asked_s is None:
            self._published_s[heard.kind] = heard.came_s
        elif heard.asked_s <= self._published_s[heard.kind]:
            return  # what was published in the meantime is newer than this answer, or the same
        try:
            if heard.payload is None:
                raise DecodeError("message_too_large", f"more than {MAX_BYTES} bytes")
            if heard.kind == HEALTH:
                self._health = from_msgpack(HealthReply, heard.payload)
            else:
                reply = from_msgpack(ExtrinsicReply, heard.payload)
                served = _rigid(reply.camera_from_lidar)
                candidate = None if reply.pending is None else _rigid(reply.pending.camera_from_lidar)
                self._extrinsic, self._served, self._candidate = reply, served, candidate
        except DecodeError as error:
            self._refused(error.reason)
            return
        self._answered_s = heard.came_s

    # --- on Zenoh's threads -----------------------------------------------------------------------------------------

    def _listener(self, kind: str, asked_s: float | None) -> Callable[[zenoh.Sample], None]:
        def hear(sample: zenoh.Sample) -> None:
            fits = len(sample.payload) <= MAX_BYTES
            payload = sample.payload.to_bytes() if fits else None
            self._heard.append(_Heard(kind, asked_s, time.monotonic(), payload))

        return hear

    @staticmethod
    def _replies(hear: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Reply], None]:
        def hear_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                hear(reply.ok)

        return hear_reply

    def _hear_of_life(self, sample: zenoh.Sample) -> None:
        self._alive = sample.kind == zenoh.SampleKind.PUT


def _directly(callback: Callable[[T], None]) -> zenoh.handlers.Callback[T]:
    return zenoh.handlers.Callback(callback, indirect=False)


def _rigid(transform: Transform) -> Matrix4:
    T_camera_lidar = matrix_of(transform)
    if not is_rigid(T_camera_lidar):
        raise DecodeError("message_fields", "a matrix that is no rotation and translation")
    return T_camera_lidar
