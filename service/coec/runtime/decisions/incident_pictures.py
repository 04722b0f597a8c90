"""Pictures for the evidence of a red event: the windows before and after it, each drawn at the extrinsic that was
served and at the one that holds since."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from coec.adapters.files.conversions import matrix_of
from coec.adapters.system.logs import LossCounter
from coec.calibration.types import Matrix4
from coec.runtime.decisions.incidents import Side
from coec.runtime.decisions.questions import JobClient
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.worker.jobs import JobOutcome, RenderedImage
from coec.schemas.replies import EvidenceEvent

SERVED = "what was served when it turned red"
"""Caption of the first extrinsic."""


class IncidentPictures:
    """Belongs to the thread that decides about the pair."""

    def __init__(
        self,
        add_picture: Callable[[str, Side, bytes], None],
        folder: WindowStore,
        job_client: JobClient,
        losses: LossCounter,
    ) -> None:
        """`keep(event_id, side, jpeg)` adds a picture to an event."""
        self._add_picture = add_picture
        self._folder = folder
        self._job_client = job_client
        self._losses = losses

    def request_overlay(self, event: EvidenceEvent) -> None:
        """Draws the window before the event at the extrinsic that was served when the event began. Nothing else is
        known at that time."""
        if event.window_before is not None:
            pose, title = matrix_of(event.camera_from_lidar), f"{event.window_before}  at {SERVED}"
            done = partial(self._on_rendered, event.event_id, "before")
            self._job_client.overlay(self._folder.path(event.window_before), pose, title, done)

    def request_comparison(self, event: EvidenceEvent, estimated: Matrix4, decision: str) -> None:
        """Draws the windows before and after the event, each at the served extrinsic and at `found` (4, 4), the result
        of the window after it. The first one fits the images before the event, the second one those after it."""
        poses = (matrix_of(event.camera_from_lidar), estimated)
        names = (SERVED, f"found by the window after it ({decision})")
        sides: tuple[tuple[Side, str | None], ...] = (("before", event.window_before), ("after", event.window_after))
        for side, window_id in sides:
            if window_id is not None:
                done = partial(self._on_rendered, event.event_id, side)
                self._job_client.comparison(self._folder.path(window_id), poses, names, done)

    def _on_rendered(self, event_id: str, side: Side, outcome: JobOutcome) -> None:
        if isinstance(outcome.answer, RenderedImage):
            self._add_picture(event_id, side, outcome.answer.jpeg)
        elif outcome.reason is not None:
            self._losses.add("storage", "overlay_not_drawn", detail=outcome.reason.text)
