"""Pictures of a pair on demand. The worker draws them, so that no thread of the service is held up; the latest ones are
kept."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from coec.calibration.types import Matrix4, Reason
from coec.errors import CoecError
from coec.runtime.worker import jobs
from coec.runtime.worker.jobs import JobOutcome, RenderedImage
from coec.runtime.worker.supervisor import Worker

CACHED_OVERLAYS = 4
"""How many pictures are kept, some hundred kB each."""

OVERLAY_TIMEOUT_S = 8.0
"""Longest wait for a picture, s: below the 10 s after which clients give up. The worker may be solving."""


class OverlayUnavailableError(CoecError):
    """The worker could not draw the picture, or not in time."""

    reply_code = "not_drawn"


class Overlays:
    """Draws the windows of one pair."""

    def __init__(self, pair: str, worker: Worker) -> None:
        self._pair = pair
        self._worker = worker
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[str, bytes], bytes] = OrderedDict()

    def jpeg(self, path: Path, T_camera_lidar: Matrix4, title: str) -> bytes:
        """JPEG of a window with its points drawn at an extrinsic (4, 4); waits for the worker.

        Raises:
            NotDrawnError: the picture did not come.
        """
        key = (path.stem, T_camera_lidar.tobytes())
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        rendered: Future[bytes | Reason] = Future()
        self.request(path, T_camera_lidar, title, rendered.set_result, OVERLAY_TIMEOUT_S)
        try:
            picture = rendered.result(OVERLAY_TIMEOUT_S)
        except TimeoutError as error:
            raise OverlayUnavailableError("the worker is busy with a window; ask again") from error
        if isinstance(picture, Reason):
            raise OverlayUnavailableError(picture.text)
        with self._lock:
            self._cache[key] = picture
            while len(self._cache) > CACHED_OVERLAYS:
                self._cache.popitem(last=False)
        return picture

    def request(
        self,
        path: Path,
        T_camera_lidar: Matrix4,
        title: str,
        done: Callable[[bytes | Reason], None],
        deadline_s: float | None = None,
    ) -> None:
        """Asks for the picture without waiting. `done` is called once, with the picture or with the reason why there is
        none, at the latest after `deadline_s` if the worker is busy (None: the default of pictures)."""

        def on_outcome(outcome: JobOutcome) -> None:
            match outcome:
                case JobOutcome(answer=RenderedImage(jpeg)):
                    done(jpeg)
                case JobOutcome(reason=Reason() as reason):
                    done(reason)

        self._worker.submit(jobs.overlay(self._pair, path, T_camera_lidar, title, on_outcome, deadline_s))
