"""Proof of progress: when a check was last completed, and when one last acquitted the served extrinsic, on both clocks;
and why none has since.

Health is green only because something was checked and found right, never because no fault was reported. Any fault that
keeps checks from being completed, known or not, shows here in the same way: no completed check comes.
"""

from dataclasses import dataclass

from coec.calibration.monitor.change_detector import ACQUITTAL_PERIODS
from coec.calibration.state import NOT_ACQUITTED
from coec.calibration.types import NS_PER_S, Reason
from coec.errors import ModelError
from coec.service.engine.frame_selector import RESULT_PERIODS
from coec.service.ingest.decoder import CAMERA, LIDAR
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.worker import compilation
from coec.service.worker.job_queue import BUSY, SUPERSEDED, WORKER_FAILED
from coec.service.worker.worker_jobs import Fate

SLOWEST_PACE = 0.1
"""Slowest replay, in seconds of sensor time per second. A slower one counts as standing still."""

REPORTED_FAILURES = 3
"""After so many failed checks, or failed windows, in a row health reports it."""

DEPTH_CODES = frozenset({ModelError.reply_code})
"""Codes of failures of the depth network."""

WORKER_CODES = frozenset(
    {
        WORKER_FAILED,
        SUPERSEDED.code,
        BUSY.code,
        Fate.LATE.value,
        compilation.CODE,
        "internal_error",
        "unsendable",
        "unanswered",
    }
)
"""Codes of failures of the worker, or on the way to it and back."""

NOT_TRIED = frozenset({compilation.CODE, SUPERSEDED.code})
"""Codes of failures that say nothing of the data: the worker did not begin. If that goes on, no check is completed, and
that is reported as `overdue_worker`."""


class Attempts:
    """Counts how many attempts of one kind have failed in a row, because a service that cannot look must not go on
    reporting that all is well. Belongs to the thread of the engine."""

    def __init__(self, what: str, code: str) -> None:
        """`what`: name of the attempts, in the plural. `code`: code of the trouble."""
        self._what = what
        self._code = code
        self._failures = 0
        self.problem: Reason | None = None

    def failed(self, reason: Reason) -> None:
        """An attempt has failed."""
        if reason.code in NOT_TRIED:
            return
        self._failures += 1
        if self._failures >= REPORTED_FAILURES:
            text = f"The last {self._failures} {self._what} gave no result. {reason.text}"
            self.problem = Reason(self._code, text)

    def succeeded(self) -> None:
        """An attempt has succeeded."""
        self._failures, self.problem = 0, None


@dataclass(slots=True)
class _Last:
    """The last completed check: steady clock, sensor time, and the report of the streams at that time."""

    monotonic_s: float
    stamp_ns: int | None
    report: StreamStatistics


def _later(before: _Last, last: _Last) -> _Last:
    """The newer of two, with the later sensor time: the last pair of a window may be older than the last check."""
    stamps_ns = [one.stamp_ns for one in (before, last) if one.stamp_ns is not None]
    return _Last(last.monotonic_s, max(stamps_ns, default=None), last.report)


class CheckProgress:
    """Progress of the checks of one pair. Belongs to the thread of the engine."""

    def __init__(self, period_s: float, monotonic_s: float, report: StreamStatistics) -> None:
        self._period_s = period_s
        self._last = self._acquitted = _Last(monotonic_s, None, report)
        self._failure: Reason | None = None

    def completed(self, stamp_ns: int | None, monotonic_s: float, report: StreamStatistics, *, acquits: bool) -> None:
        """A check of pairs up to this sensor time was completed; or a window, which says even more. `acquits`: whether
        it acquits the served extrinsic."""
        self._last = _later(self._last, _Last(monotonic_s, stamp_ns, report))
        if acquits:
            self._acquitted = _later(self._acquitted, _Last(monotonic_s, stamp_ns, report))
        self._failure = None

    def failed(self, reason: Reason) -> None:
        """A check has failed."""
        self._failure = reason

    def time_stepped_back(self) -> None:
        """Sensor time has stepped back, so earlier stamps say nothing any more."""
        self._last.stamp_ns = self._acquitted.stamp_ns = None

    def silent_s(self, monotonic_s: float) -> float:
        """Time since the last completed check, or since the start, s."""
        return monotonic_s - self._last.monotonic_s

    def overdue(self, report: StreamStatistics, monotonic_s: float, *, at_rest: bool) -> Reason | None:
        """Why no check was completed, or none acquitted the extrinsic, for `ACQUITTAL_PERIODS` periods, by the steady
        clock or by sensor time; None if one did. `at_rest`: the acquitting check of the place where the vehicle stands
        still counts. For a replay that is slower than the drive the limit is longer in proportion."""
        late_s = self._late_s(self._last, report, monotonic_s)
        if late_s is not None:
            code, why = self._cause(report)
            return Reason(f"overdue_{code}", f"No check has been completed for {late_s:.0f} s: {why}")
        late_s = None if at_rest else self._late_s(self._acquitted, report, monotonic_s)
        if late_s is None:
            return None
        return Reason(NOT_ACQUITTED, f"Checks are completed, but none has confirmed the extrinsic for {late_s:.0f} s.")

    def _late_s(self, last: _Last, report: StreamStatistics, monotonic_s: float) -> float | None:
        """Time since `last`, s, if it is longer than allowed."""
        pace = 1.0 if report.pace is None else min(max(report.pace, SLOWEST_PACE), 1.0)
        silent_s, unseen_s = monotonic_s - last.monotonic_s, 0.0
        if last.stamp_ns is not None and report.selection.last_ns is not None:
            unseen_s = (report.selection.last_ns - last.stamp_ns) / NS_PER_S
        late = silent_s > ACQUITTAL_PERIODS * self._period_s / pace
        # The stream may run ahead of an answer by `ANSWER_PERIODS`.
        late |= unseen_s > (ACQUITTAL_PERIODS + RESULT_PERIODS) * self._period_s
        return max(silent_s, unseen_s) if late else None

    def _cause(self, now: StreamStatistics) -> tuple[str, str]:
        """What has stood still since the last completed check: the first such stage on a frame's way."""
        then = self._last.report
        for stream in (CAMERA, LIDAR):
            before, after = then.streams.get(stream), now.streams.get(stream)
            received = (after.received if after else 0) - (before.received if before else 0)
            accepted = (after.accepted if after else 0) - (before.accepted if before else 0)
            if received == 0:
                return "data", f"no {stream} frames come."
            if accepted == 0:
                return "data", f"every {stream} frame is refused; `data_quality.drops` says why."
        if now.pairs == then.pairs:
            return "pairing", "camera and LiDAR frames come, but none belong together in time."
        if self._failure is not None:
            return self._kind_of(self._failure), self._failure.text
        if now.selection.checks == then.selection.checks and now.selection.not_afforded > then.selection.not_afforded:
            return "budget", "`budget.cores` does not suffice; `budget` of status says for what."
        if now.selection.checks == then.selection.checks and now.selection.unanswered > 0:
            return "worker", "a window is being solved, and checks wait for its result."
        if now.selection.checks == then.selection.checks:
            return "data", "too few pairs come, or they are too far apart, for a check."
        return "worker", "the worker has not answered."

    @staticmethod
    def _kind_of(failure: Reason) -> str:
        if failure.code in DEPTH_CODES:
            return "depth"
        return "worker" if failure.code in WORKER_CODES else "data"
