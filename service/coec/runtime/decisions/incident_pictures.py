"""Pictures for the evidence of a red event: the windows before and after it, at what was served when it began."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from coec.adapters.files.conversions import matrix_of
from coec.adapters.system.logs import LossCounter
from coec.runtime.decisions.incidents import Side
from coec.runtime.decisions.questions import Questions
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.worker.jobs import Drawn, JobOutcome
from coec.schemas.replies import EvidenceEvent


class IncidentPictures:
    """Belongs to the thread that decides about the pair."""

    def __init__(
        self,
        keep: Callable[[str, Side, bytes], None],
        folder: WindowStore,
        questions: Questions,
        losses: LossCounter,
    ) -> None:
        """`keep(event_id, side, jpeg)` adds a picture to an event."""
        self._keep = keep
        self._folder = folder
        self._questions = questions
        self._losses = losses

    def draw_both(self, event: EvidenceEvent) -> None:
        """Of the windows that the event has so far."""
        sides: tuple[tuple[Side, str | None], ...] = (("before", event.window_before), ("after", event.window_after))
        for side, window_id in sides:
            if window_id is not None:
                self.draw(event, window_id, side)

    def draw(self, event: EvidenceEvent, window_id: str, side: Side) -> None:
        """Of one window."""
        pose, title = matrix_of(event.camera_from_lidar), f"{window_id}  {side} {event.event_id}"
        done = partial(self._drawn, event.event_id, side)
        self._questions.overlay(self._folder.path(window_id), pose, title, done)

    def _drawn(self, event_id: str, side: Side, outcome: JobOutcome) -> None:
        if isinstance(outcome.answer, Drawn):
            self._keep(event_id, side, outcome.answer.jpeg)
        elif outcome.reason is not None:
            self._losses.add("storage", "overlay_not_drawn", detail=outcome.reason.text)
