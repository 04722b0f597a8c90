"""Pictures of the pairs that are being checked. They are drawn only while somebody subscribes, one at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import Protocol

from coec.adapters.ros.outgoing import encode_jpeg
from coec.calibration.types import FramePair, Matrix4
from coec.config import PairConfig
from coec.runtime.worker import jobs
from coec.runtime.worker.jobs import Drawn, Job, JobOutcome

PERIOD_S = 1.0
"""Time between two pictures of a pair, s. A picture takes the worker some tenths of a second."""


class Asks(Protocol):
    """The worker."""

    def ask(self, job: Job) -> None:
        """See `runtime.worker.supervisor`."""


class Topic(Protocol):
    """The publisher of a pair's pictures."""

    @property
    def is_heard(self) -> bool:
        """Whether somebody subscribes."""

    def put(self, payload: bytes, source_ns: int) -> None:
        """Publishes a message in CDR."""


class Pictures:
    """The pictures of all pairs. For any thread."""

    def __init__(self, worker: Asks, topics: Mapping[str, Topic]) -> None:
        """`topics` holds the publishers by names of pairs; further ones may be added later."""
        self._worker = worker
        self._topics = topics
        self._lock = threading.Lock()
        self._asked_s: dict[str, float] = {}
        self._under_way: set[str] = set()

    def show(self, pair: PairConfig, drawn: FramePair, T_camera_lidar: Matrix4) -> None:
        """Has a pair of the stream drawn that is being checked at an extrinsic (4, 4), if somebody subscribes and the
        last picture is done and old enough."""
        topic = self._topics.get(pair.name)
        if topic is None or not topic.is_heard or not self._begin(pair.name):
            return
        done = partial(self._drawn, pair.name, drawn.camera.stamp_ns, drawn.camera.frame_id)
        self._worker.ask(
            jobs.picture(pair.name, pair.calibration, T_camera_lidar, drawn, f"{pair.name}  current", done)
        )

    def _begin(self, pair: str) -> bool:
        now_s = time.monotonic()
        with self._lock:
            if pair in self._under_way or now_s - self._asked_s.get(pair, -PERIOD_S) < PERIOD_S:
                return False
            self._under_way.add(pair)
            self._asked_s[pair] = now_s
        return True

    def _drawn(self, pair: str, stamp_ns: int, frame_id: str, outcome: JobOutcome) -> None:
        with self._lock:
            self._under_way.discard(pair)
        if isinstance(outcome.answer, Drawn):
            self._topics[pair].put(encode_jpeg(stamp_ns, frame_id, outcome.answer.jpeg), time.time_ns())
