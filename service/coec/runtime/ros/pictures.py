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
from coec.runtime.worker.jobs import JobOutcome, RenderedImage, WorkerJob

PICTURE_PERIOD_S = 1.0
"""Time between two pictures of a pair, s. A picture takes the worker some tenths of a second."""


class JobSubmitter(Protocol):
    """The worker."""

    def submit(self, job: WorkerJob) -> None:
        """See `runtime.worker.supervisor`."""


class PictureTopic(Protocol):
    """The publisher of a pair's pictures."""

    @property
    def has_subscribers(self) -> bool:
        """Whether somebody subscribes."""

    def put(self, payload: bytes, source_ns: int) -> None:
        """Publishes a message in CDR."""


class CheckPictures:
    """The pictures of all pairs. For any thread."""

    def __init__(self, worker: JobSubmitter, topics: Mapping[str, PictureTopic]) -> None:
        """`topics` holds the publishers by names of pairs; further ones may be added later."""
        self._worker = worker
        self._topics = topics
        self._lock = threading.Lock()
        self._requested_s: dict[str, float] = {}
        self._under_way: set[str] = set()

    def show(self, pair: PairConfig, frame_pair: FramePair, T_camera_lidar: Matrix4) -> None:
        """Has a pair of the stream drawn that is being checked at an extrinsic (4, 4), if somebody subscribes and the
        last picture is done and old enough."""
        topic = self._topics.get(pair.name)
        if topic is None or not topic.has_subscribers or not self._begin(pair.name):
            return
        done = partial(self._on_rendered, pair.name, frame_pair.camera.stamp_ns, frame_pair.camera.frame_id)
        self._worker.submit(
            jobs.picture(pair.name, pair.calibration, T_camera_lidar, frame_pair, f"{pair.name}  current", done)
        )

    def _begin(self, pair: str) -> bool:
        now_s = time.monotonic()
        with self._lock:
            if pair in self._under_way or now_s - self._requested_s.get(pair, -PICTURE_PERIOD_S) < PICTURE_PERIOD_S:
                return False
            self._under_way.add(pair)
            self._requested_s[pair] = now_s
        return True

    def _on_rendered(self, pair: str, stamp_ns: int, frame_id: str, outcome: JobOutcome) -> None:
        with self._lock:
            self._under_way.discard(pair)
        if isinstance(outcome.answer, RenderedImage):
            self._topics[pair].put(encode_jpeg(stamp_ns, frame_id, outcome.answer.jpeg), time.time_ns())
