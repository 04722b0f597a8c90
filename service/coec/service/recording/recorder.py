"""The thread that writes the windows of all pairs. A failure here costs a window, never the service. In its idle time
it reads windows that the store does not know yet, a few MB at a time, for their digests.
"""

import contextlib
import hashlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from coec.calibration.frames.window import CarriedOverPairs, SliceClosed
from coec.calibration.types import FramePair, Matrix4, Reason, Rig
from coec.config import CalibrationConfig
from coec.errors import CoecError, RecordingError, WindowError
from coec.io import storage
from coec.io.logs import LossCounter
from coec.io.mcap.windows import RecordedWindow, WindowWriter, pairs_since, read_result, salvage
from coec.io.system import ServiceThread
from coec.schemas.replies import CalibrationResult
from coec.service.recording.snippets import SnippetRecorder
from coec.service.recording.window_store import WindowStore, WindowVersion
from coec.service.timing import QUICK_S, Histogram

_log = logging.getLogger(__name__)


DIGEST_ROUND_S = 0.1
"""After this time a round ends, however little was read: pairs may wait to be written, and the thread must beat."""

PIECE_BYTES = 2**16
"""Bytes that are read at once: 0.7 s on a disk that gives 100 kB/s."""


@dataclass(slots=True)
class _Reading:
    """The file that is being read. It stays open, even if another file takes its name.

    Attributes:
        initial_status: status of the file at the beginning.
    """

    path: Path
    stream: BinaryIO
    initial_status: os.stat_result
    result: CalibrationResult | None
    sha256: Any = field(default_factory=hashlib.sha256)


class DigestReader:
    """Reads the windows of one pair that the store does not know: those that neither its recorder nor its worker wrote,
    or whose line in the index was lost. Owned by one thread."""

    def __init__(self, store: WindowStore, pair: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a clock in seconds that never goes back."""
        self._clock = clock
        self._store = store
        self._pair = pair
        self._reading: _Reading | None = None
        self._unreadable: set[str] = set()

    def read(self, max_bytes: int) -> bool:
        """Reads on by at most `max_bytes`, fewer if the disk is slow. The latest window comes first. False: there is
        nothing to read."""
        if self._reading is None:
            unread = self._store.unread(self._pair)
            self._unreadable.intersection_update(unread)
            window_id = next((one for one in unread if one not in self._unreadable), None)
            if window_id is None:
                return False
            path = self._store.path(window_id)
            self._guarded(path, lambda: self._begin(path))
        reading = self._reading
        if reading is not None:
            self._guarded(reading.path, lambda: self._go_on(reading, max_bytes))
        return True

    def close(self) -> None:
        """Closes the file that is being read."""
        if self._reading is not None:
            self._reading.stream.close()
            self._reading = None

    def _guarded(self, path: Path, step: Callable[[], None]) -> None:
        """Runs a step. A file that cannot be read is left alone until the next start; one that has gone is ignored."""
        try:
            step()
        except FileNotFoundError:
            self.close()
        except OSError as error:
            self.close()
            self._unreadable.add(path.stem)
            _log.warning(f"a window cannot be read: {error.strerror}", extra={"fields": {"window": path.stem}})

    def _begin(self, path: Path) -> None:
        stream = path.open("rb")
        try:
            self._reading = _Reading(path, stream, os.fstat(stream.fileno()), _result_in(path))
        except BaseException:
            stream.close()
            raise

    def _go_on(self, reading: _Reading, max_bytes: int) -> None:
        end_s = self._clock() + DIGEST_ROUND_S
        while max_bytes > 0 and (data := reading.stream.read(min(max_bytes, PIECE_BYTES))):
            reading.sha256.update(data)
            max_bytes -= len(data)
            if self._clock() >= end_s:
                return
        if max_bytes <= 0:
            return
        status, initial = os.fstat(reading.stream.fileno()), reading.initial_status
        self.close()
        if (status.st_size, status.st_mtime_ns) != (initial.st_size, initial.st_mtime_ns):
            return  # somebody is writing into the file, so it is read again
        version = WindowVersion(
            size_bytes=status.st_size,
            modified_ns=status.st_mtime_ns,
            sha256=reading.sha256.hexdigest(),
            pairs=reading.result.pairs if reading.result else None,
            decision=reading.result.verdict.decision if reading.result else None,
        )
        self._store.note(reading.path.stem, version)
        self._store.flush()


def _result_in(path: Path) -> CalibrationResult | None:
    """The result in a window's file; None if it has none or is damaged. A damaged window is listed all the same, so
    that people can look into it."""
    try:
        return read_result(path)
    except WindowError as error:
        _log.warning(f"a window is damaged: {error}", extra={"fields": {"window": path.stem}})
        return None


PAIRS_WAITING = 8
"""How many pairs may wait for the disk, some MB each."""

BETWEEN_WAITING = 32
"""How many thinned pairs may wait for the disk, a third of a MB each. A disk that does not answer for half a minute
then holds nothing up."""

UNSOLVED_RESUMED = 4
"""How many unsolved windows of earlier runs are solved after a start, newest first."""

POLL_S = 0.2
"""Time between two looks at the folder, s: by so much the list lags behind files that others put there."""

STUCK_S = 2.0
"""Without a beat of the thread for this time, s, the disk counts as stuck. The thread beats several times a second, and
between two writes."""

DIGEST_BYTES = 4 * 2**20
"""Bytes of a window that are read for its digest in one round, between pairs: 8 ms of hashing at 500 MB/s."""

DIGEST_PAUSE_S = 0.02
"""Pause between such rounds, s: the disk is left to the pairs, and 4 GB of windows still take less than a minute."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordPair:
    """A frame pair was selected for a window, whose search will start at `T_camera_lidar` (4, 4) if it is the
    first."""

    window_id: str
    pair: FramePair
    T_camera_lidar: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class RecordBetween:
    """A thinned frame pair is to be recorded beside the selected ones."""

    window_id: str
    pair: FramePair


@dataclass(frozen=True, slots=True)
class WindowRecorded:
    """A window is on the disk, and held there until the receiver of this event releases it. `live` is False for an
    unsolved window of an earlier run."""

    window_id: str
    path: Path
    live: bool


@dataclass(frozen=True, slots=True)
class WindowLost:
    """A window has ended without being recorded."""

    window_id: str


@dataclass(slots=True)
class _OpenWindow:
    """The window being written."""

    window_id: str
    writer: WindowWriter
    min_pairs: int
    pairs: int = 0


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """What all windows of a pair have in common. `packed`: clouds and raw images are compressed."""

    rig: Rig
    configuration: CalibrationConfig
    min_pairs: int
    metadata: dict[str, str]
    packed: bool = False


class RecordingThread:
    """The thread of all recorders, because one disk writes no faster for many."""

    def __init__(self) -> None:
        self.thread = ServiceThread("recorder", self._run)
        self.condition = threading.Condition()
        self._recorders: tuple[Recorder, ...] = ()

    def join(self, recorder: "Recorder") -> None:
        """A recorder takes part from now on."""
        with self.condition:
            self._recorders = (*self._recorders, recorder)
            self.condition.notify()

    def request_stop(self) -> None:
        """Has the thread write what waits, finish or abandon the open windows, and end."""
        self.thread.request_stop()
        with self.condition:
            self.condition.notify()

    def _run(self, thread: ServiceThread) -> None:
        unread = True
        while self._work() or not thread.stopping:
            with self.condition:
                if not any(recorder.has_work for recorder in self._recorders) and not thread.stopping:
                    self.condition.wait(DIGEST_PAUSE_S if unread else POLL_S)
            unread = False
            for recorder in self._recorders:
                thread.beat()
                unread |= not recorder.has_work and not thread.stopping and recorder.work_in_idle_time()
        for recorder in self._recorders:
            recorder.close()

    def _work(self) -> bool:
        """Has each recorder do all that waits; returns whether something did."""
        worked = False
        for recorder in self._recorders:
            while recorder.work():
                self.thread.beat()
                worked = True
        self.thread.beat()
        return worked


class Recorder:
    """Writes the windows of one pair, and completes what earlier runs left unfinished. `work`, `work_in_idle_time` and
    `close` are for the thread of the recorders, the rest is for any.

    Attributes:
        recorded: number of windows that got to the disk.
        writing_took: how long it took to write each pair into its window.
    """

    def __init__(
        self,
        plan: RecordingPlan,
        store: WindowStore,
        losses: LossCounter,
        recording: RecordingThread,
        post: Callable[[str, WindowRecorded | WindowLost], None],
        snippets: SnippetRecorder | None = None,
    ) -> None:
        """The recorder works once it has joined `recording`. `post(pair, event)` hands over an event for each window
        that ended. `snippets` are written between the frame pairs."""
        self._plan = plan
        self._configuration = plan.configuration
        self._store = store
        self._digests = DigestReader(store, plan.rig.pair)
        self._snippets = snippets
        self._losses = losses
        self._thread = recording.thread
        self._post = post
        self._condition = recording.condition
        self._queue: deque[RecordPair | RecordBetween | SliceClosed | CalibrationConfig] = deque()
        self._adds = 0
        self._betweens = 0
        self._open: _OpenWindow | None = None
        self._lost: str | None = None
        self._latest: Path | None = None
        self._is_resumed = False
        self.recorded = 0
        self.writing_took = Histogram(QUICK_S)
        self._problem: Reason | None = None

    @property
    def problem(self) -> Reason | None:
        """Why windows cannot be recorded; None while they can."""
        silent_s = self._thread.silence_s
        if self._problem is None and silent_s > STUCK_S:
            text = f"The disk has not answered for {silent_s:.0f} s: no window can be recorded."
            return Reason("recording_stuck", text)
        return self._problem

    @property
    def latest(self) -> Path | None:
        """The latest finished window; None if there is none on the disk."""
        return self._latest

    @property
    def waiting(self) -> int:
        """Number of chosen pairs that wait for the disk."""
        return self._adds

    @property
    def has_room(self) -> bool:
        """Whether `add` would take a pair now, selected or thinned."""
        return self._adds < PAIRS_WAITING and self._betweens < BETWEEN_WAITING

    def reconfigure(self, configuration: CalibrationConfig) -> None:
        """Queues another configuration for the windows that begin after it in the queue. Called when the limits of the
        rig were learned anew, or do not fit the rig."""
        self._put(configuration)

    def follow(self, plan: RecordingPlan) -> None:
        """Records the next window by this plan. Its configuration of the calibration is ignored; `reconfigure` sets
        that."""
        self._plan = plan

    def add(self, item: RecordPair | RecordBetween) -> None:
        """Queues a pair; never waits for the disk."""
        selected = isinstance(item, RecordPair)
        with self._condition:
            overrun = self._adds >= PAIRS_WAITING if selected else self._betweens >= BETWEEN_WAITING
            if not overrun:
                self._adds += selected
                self._betweens += not selected
                self._put(item)
        if overrun:
            self._losses.add("window", "recorder_overrun")

    def end(self, closed: SliceClosed) -> None:
        """Queues the end of a window. It is finished if it holds enough pairs, else abandoned."""
        self._put(closed)

    def _put(self, item: RecordPair | RecordBetween | SliceClosed | CalibrationConfig) -> None:
        with self._condition:
            self._queue.append(item)
            self._condition.notify()

    # --- on the thread of the recorders -----------------------------------------------------------------------------

    @property
    def has_work(self) -> bool:
        """Whether something waits to be written."""
        return bool(self._queue) or not self._is_resumed

    def work(self) -> bool:
        """Does the oldest thing that waits; returns whether something did. The first time it completes what earlier
        runs left."""
        if not self._is_resumed:
            self._is_resumed = True
            self._resume()
        with self._condition:
            item = self._queue.popleft() if self._queue else None
            self._adds -= isinstance(item, RecordPair)
            self._betweens -= isinstance(item, RecordBetween)
        if isinstance(item, RecordPair | RecordBetween):
            started_s = time.monotonic()
            self._write(item)
            self.writing_took.add(time.monotonic() - started_s)
        elif isinstance(item, SliceClosed):
            self._end(item.window_id, item.carried_over)
        elif isinstance(item, CalibrationConfig):
            self._configuration = item
        return item is not None

    def work_in_idle_time(self) -> bool:
        """Writes on in a snippet, or reads on in windows that the store does not know. False: there is nothing to
        do."""
        return (self._snippets is not None and self._snippets.write()) or self._read()

    def close(self) -> None:
        """Finishes or abandons the open window."""
        self._digests.close()
        if self._open is not None:
            self._end(self._open.window_id, None)
        if self._snippets is not None:
            self._snippets.close()

    def _read(self) -> bool:
        """Reads on in windows that the store does not know; this also notices what others have done in the folder.
        False: there is nothing to read."""
        try:
            return self._digests.read(DIGEST_BYTES)
        except OSError as error:
            self._losses.add("storage", "windows_not_listed", detail=f"the folder of windows: {error.strerror}")
            return False

    def _resume(self) -> None:
        pair = self._plan.rig.pair
        for part in self._store.leftovers(pair):
            self._salvage(part)
        windows = self._store.windows(pair)
        self._latest = windows[-1] if windows else None
        unsolved: list[Path] = []
        for path in reversed(windows):
            self._thread.beat()
            if len(unsolved) == UNSOLVED_RESUMED:
                break
            with contextlib.suppress(CoecError, OSError):
                version = self._store.version(path.stem)
                if (read_result(path) if version is None else version.decision) is None:
                    unsolved.append(path)
        for path in unsolved:
            self._hand_over(path.stem, path, live=False)
        if self._snippets is not None:
            self._snippets.resume(self._thread.beat)

    def _salvage(self, part: Path) -> None:
        try:
            window = salvage(part, self._thread.beat)
            if window is not None and window.pairs < self._plan.min_pairs:
                storage.remove(window.path)
                window = None
        except (CoecError, OSError) as error:
            self._losses.add("window", "salvage_failed", detail=str(error))
            return
        if window is None:
            self._losses.add("window", "too_few_pairs_salvaged")
            return
        self._store.add(window)
        _log.info("a window was salvaged", extra={"fields": {"window": window.window_id, "pairs": window.pairs}})

    def _hand_over(self, window_id: str, path: Path, *, live: bool) -> None:
        self._store.hold(window_id)
        self._post(self._plan.rig.pair, WindowRecorded(window_id, path, live))

    def _write(self, item: RecordPair | RecordBetween) -> None:
        if item.window_id == self._lost:
            return
        try:
            if isinstance(item, RecordBetween):
                # A window without a selected pair is not on the disk.
                if self._open is not None and self._open.window_id == item.window_id:
                    self._open.writer.add_between(item.pair)
                return
            if self._open is None or self._open.window_id != item.window_id:
                self._close_stray()
                self._open = self._start(item)
            self._open.writer.add(item.pair)
            self._open.pairs += 1
        except (RecordingError, OSError) as error:
            self._lose(item.window_id, error)

    def _start(self, item: RecordPair) -> _OpenWindow:
        plan = self._plan  # `follow` may replace it meanwhile
        self._store.make_room(self._thread.beat)
        writer = WindowWriter(
            self._store.path(item.window_id),
            plan.rig,
            item.T_camera_lidar,
            item.window_id,
            self._configuration,
            plan.metadata,
            packed=plan.packed,
        )
        return _OpenWindow(item.window_id, writer, plan.min_pairs)

    def _end(self, window_id: str, carried_over: CarriedOverPairs | None) -> None:
        if self._open is None or self._open.window_id != window_id:
            self._post(self._plan.rig.pair, WindowLost(window_id))
            return
        opened = self._open
        try:
            if carried_over is not None:
                self._add_carried_over(carried_over, opened)
            if opened.pairs < opened.min_pairs:
                self._close_stray()
                self._post(self._plan.rig.pair, WindowLost(window_id))
                return
            recorded = opened.writer.finish()
        except (RecordingError, OSError) as error:
            self._lose(window_id, error)
            self._post(self._plan.rig.pair, WindowLost(window_id))
            return
        self._open = None
        self._finished(recorded)

    def _add_carried_over(self, carried_over: CarriedOverPairs, into: _OpenWindow) -> None:
        """Copies the pairs that another window keeps for this one. They are on the disk, so keeping them costs no
        memory, and they survive a restart."""
        before = into.pairs
        try:
            into.writer.note_carried_over(carried_over.window_id, carried_over.since_ns)
            for pair in pairs_since(self._store.path(carried_over.window_id), carried_over.since_ns):
                self._thread.beat()
                into.writer.add(pair)
                into.pairs += 1
        except WindowError as error:
            self._losses.add("window", "kept_pairs_lost", carried_over.pairs - (into.pairs - before), detail=str(error))

    def _finished(self, recorded: RecordedWindow) -> None:
        self.recorded += 1
        self._problem = None
        self._latest = recorded.path
        self._store.add(recorded)
        fields = {"window": recorded.window_id, "pairs": recorded.pairs, "bytes": recorded.bytes}
        _log.info("window recorded", extra={"fields": {"pair": self._plan.rig.pair, **fields}})
        self._hand_over(recorded.window_id, recorded.path, live=True)

    def _close_stray(self) -> None:
        """Abandons the open window, because it ended with too few pairs."""
        if self._open is not None:
            self._open.writer.abandon()
            self._open = None
            self._problem = None  # the pairs that it had could be written
            self._losses.add("window", "too_few_pairs")

    def _lose(self, window_id: str, error: Exception) -> None:
        """Gives up the window after an error; the next window tries again."""
        self._lost = window_id
        self._problem = Reason("recording_failed", f"The last window could not be recorded: {error}")
        self._losses.add("window", "recording_failed", detail=str(error))
        if self._open is not None:
            with contextlib.suppress(RecordingError, OSError):
                self._open.writer.abandon()
            self._open = None
