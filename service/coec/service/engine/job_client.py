"""Submits the jobs of a pair to the worker, and passes their results to the thread that manages the pair: checks and
windows for its stream and its recorder, and pictures for the evidence of an incident. Such pictures show the
windows before and after the incident, each at the extrinsic that was served and at the one that holds since.
"""

import logging
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol

from coec.calibration.frames.window import stands
from coec.calibration.types import FramePair, Matrix4
from coec.config import PairConfig
from coec.io.logs import LossCounter
from coec.io.serialise import matrix_of
from coec.schemas.replies import EvidenceEvent
from coec.service.cpu_budget import Budget
from coec.service.engine.frame_selector import ServedExtrinsic
from coec.service.engine.rig import PairCorrection, RigMember
from coec.service.engine.schedule import PendingRequest, ResultSchedule
from coec.service.recording.window_store import WindowStore, start_ns_of
from coec.service.records.incidents import Side
from coec.service.task_queue import TaskQueue
from coec.service.timing import NS_PER_S
from coec.service.worker import worker_jobs
from coec.service.worker.supervisor import Worker
from coec.service.worker.worker_jobs import JobOutcome, RenderedImage

_log = logging.getLogger(__name__)

RESULT_PERIODS = 1
"""After so many periods of the monitor the answer to a check or a window counts in the choice of further pairs. At 5 s
this is longer than either takes. If an answer takes longer, the stream waits, and its pairs are held."""

GRACE_S = 30.0
"""Time beyond the worker's deadline, s, for an answer to get from there to here, and for a window to get to the disk.
After that it is given up as lost."""


class ResultSink(Protocol):
    """Who takes the answers, on the thread that decides about the pair; see `runtime.decisions.decider`."""

    def checked(self, request: PendingRequest, epoch: int, standing_ns: tuple[int, ...], outcome: JobOutcome) -> None:
        """A check of the extrinsic of `epoch` has ended. `standing_ns`: stamps of its pairs that were taken while the
        vehicle stood."""

    def solved(self, window_id: str, outcome: JobOutcome, *, live: bool) -> None:
        """The solve of a window has ended."""

    def lost(self, window_id: str) -> None:
        """A window ended without being recorded."""

    def corrected(self, request: PendingRequest, correction: PairCorrection) -> None:
        """The rig has a correction for the pair."""

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""


class JobClient:
    """Asks questions about one pair, for its stream (`ingest.chooser.Asks`) and its recorder. For any thread."""

    def __init__(
        self,
        pair: PairConfig,
        queue: ResultSchedule,
        worker: Worker,
        budget: Budget,
        mailbox: TaskQueue,
        windows: WindowStore,
        rig: RigMember,
        show: Callable[[PairConfig, FramePair, Matrix4], None],
    ) -> None:
        """`show(pair, drawn, pose)` is called for every check with one of its pairs of frames, and with the extrinsic
        (4, 4) that is checked."""
        self._pair = pair
        self._show = show
        self._windows = windows
        self._rig = rig
        self._queue = queue
        self._worker = worker
        self._budget = budget
        self._mailbox = mailbox
        self._period_ns = round(pair.monitor.period_s * NS_PER_S)
        self._latest_window_ns = 0
        self._sink: ResultSink

    def connect(self, sink: ResultSink) -> None:
        """Sets who takes the answers; called once, before anything is asked."""
        self._sink = sink

    def reconfigure(self, pair: PairConfig) -> None:
        """Asks by these settings from now on. The period of the monitor stays that of the start, because the due times
        of waiting questions were set by it."""
        self._pair = pair

    # --- for the stream ---------------------------------------------------------------------------------------------

    def try_acquire(self, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether the budget allows a check at a sensor time. If it does, the caller must ask for that check. Checks of
        `suspected` pairs come first."""
        return self._budget.try_acquire(self._pair.name, stamp_ns, suspected=suspected)

    @property
    def stretch(self) -> float:
        """Factor by which slices are to be longer than configured, at least 1."""
        return self._budget.stretch

    def pop_window_request(self, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants pairs for a window, asked before a pair of this stamp; returned once.
        None: it wants no window, or one that began after that time is on its way or known."""
        since_ns = self._rig.pop_window_request(stamp_ns)
        return None if since_ns is None or since_ns <= self._latest_window_ns else since_ns

    def window_turn_s(self, stamp_ns: int) -> float:
        """By how much the end of a window that the rig wants may be delayed, s, so that the budget can pay for the
        windows before it. The window then counts as being on its way."""
        return self._budget.window_turn_s(self._pair.name, stamp_ns)

    def check(self, pairs: tuple[FramePair, ...], served: ServedExtrinsic, stamp_ns: int) -> None:
        """Asks at a sensor time whether `served` is right according to these pairs. Only after `affords`."""
        standing = tuple(pair.stamp_ns for pair in pairs if stands(pair, self._pair.window))
        request = self._queue.submit(self._due_ns(stamp_ns), self._expires_s(worker_jobs.Kind.CHECK))
        post = self._post(partial(self._sink.checked, request, served.epoch, standing))
        pair = self._pair

        def done(outcome: JobOutcome) -> None:
            self._budget.release(pair.name)
            post(outcome)

        self._worker.submit(worker_jobs.check(pair.name, pair.calibration, served.T_camera_lidar, pairs, done))
        self._show(pair, pairs[-1], served.T_camera_lidar)

    def window(self, window_id: str, stamp_ns: int) -> int:
        """Asks for the result of a window that ends at a sensor time and is on its way to the disk. Returns from which
        sensor time the answer counts."""
        self._latest_window_ns = start_ns_of(window_id)
        return self._queue.submit(self._due_ns(stamp_ns), self._expires_s(worker_jobs.Kind.SOLVE), window_id).due_ns

    def prefetch(self, frame: bytes) -> None:
        """Announces that the depth of a camera frame (native msgpack) will be needed."""
        self._worker.prefetch(self._pair.name, frame)

    @property
    def unanswered(self) -> int:
        """Number of checks and windows whose answer has not come."""
        return self._queue.unanswered

    def waits(self, stamp_ns: int) -> bool:
        """Whether an answer of the worker or of the rig is due before a pair of this stamp and has not come. None is
        awaited while the worker compiles its kernels, because that takes longer than frames can be held."""
        waits = self._queue.waits(stamp_ns) and not self._worker.warms_up
        if self._rig.must_wait(stamp_ns, for_own=waits) or waits:
            return True
        corrections = self._rig.corrections(stamp_ns)
        for correction in corrections:
            request = self._queue.submit(correction.from_ns, time.monotonic() + GRACE_S)
            self._mailbox.post(partial(self._sink.corrected, request, correction))
        return bool(corrections) and self._queue.waits(stamp_ns) and not self._worker.warms_up

    def settle(self, stamp_ns: int) -> None:
        """Lets the answers take effect that are due before a pair of this stamp."""
        self._queue.settle(stamp_ns)

    def bring_forward(self, stamp_ns: int) -> None:
        """Makes all outstanding answers due before a pair of this stamp, which is the first after a step back of sensor
        time."""
        self._queue.bring_forward(stamp_ns)

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""
        self._latest_window_ns = 0
        self._rig.time_stepped_back(stamp_ns)
        self._mailbox.post(partial(self._sink.time_stepped_back, stamp_ns))

    # --- for the recorder, and for whoever wants a window solved again -----------------------------------------------

    def solve(self, window_id: str, path: Path, live: bool) -> None:
        """Has a window on the disk solved. `live` is False for a window of an earlier run."""
        post = self._post(partial(self._sink.solved, window_id, live=live))

        def done(outcome: JobOutcome) -> None:
            self._windows.release(window_id)
            post(outcome)

        self._windows.hold(window_id)
        self._worker.submit(worker_jobs.solve(self._pair.name, path, window_id, done, live))

    def lost(self, window_id: str) -> None:
        """A window ended without being recorded."""
        self._mailbox.post(partial(self._sink.lost, window_id))

    # --- for the decider --------------------------------------------------------------------------------------------

    def overlay(self, path: Path, pose: Matrix4, title: str, done: Callable[[JobOutcome], None]) -> None:
        """Has a window drawn at an extrinsic (4, 4)."""
        self._worker.submit(worker_jobs.overlay(self._pair.name, path, pose, title, self._post(done)))

    def comparison(
        self, path: Path, poses: tuple[Matrix4, Matrix4], names: tuple[str, str], done: Callable[[JobOutcome], None]
    ) -> None:
        """Has a window drawn at two extrinsics (4, 4); `names` are their captions."""
        self._worker.submit(worker_jobs.comparison(self._pair.name, path, poses, names, self._post(done)))

    def commission(self, pose: Matrix4, paths: list[Path], done: Callable[[JobOutcome], None]) -> None:
        """Has the baseline of the rig learned at an extrinsic (4, 4) from windows, which stay on the disk until that is
        done."""
        post = self._post(done)

        def finished(outcome: JobOutcome) -> None:
            for path in paths:
                self._windows.release(path.stem)
            post(outcome)

        for path in paths:
            self._windows.hold(path.stem)
        self._worker.submit(worker_jobs.commission(self._pair.name, self._pair.calibration, pose, paths, finished))

    @property
    def commissioning(self) -> str | None:
        """How far the commissioning of the pair is, in words; None: it has none."""
        return self._worker.commissioning(self._pair.name)

    def _post(self, on_outcome: Callable[[JobOutcome], None]) -> Callable[[JobOutcome], None]:
        return lambda outcome: self._mailbox.post(partial(on_outcome, outcome))

    def _due_ns(self, stamp_ns: int) -> int:
        return stamp_ns + RESULT_PERIODS * self._period_ns

    def _expires_s(self, kind: worker_jobs.Kind) -> float:
        return time.monotonic() + worker_jobs.DEADLINE_S[kind] + GRACE_S


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
