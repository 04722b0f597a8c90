"""Two LiDARs on the thread of the intake: sweeps -> look -> worker -> report to the rig.

Only sensor time decides which sweeps are taken, and from when their result counts, so a replay of a drive gives the
same at any rate. The rig waits for everything that counts by its sensor time (`runtime.rig.order`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from coec.calibration.lidar_to_lidar.sampling import MissedSweep, SampledSweeps, SweepSampler, SweepSet
from coec.calibration.lidar_to_lidar.types import LEAST_SHARE
from coec.calibration.rig.lidar_looks import determined_covariance, observation_of_registration, window_of
from coec.calibration.rig.vehicle import EdgeWindow
from coec.calibration.types import EgoMotion, LidarFrame, Reason
from coec.runtime.budget.budget import Budget
from coec.runtime.edges.plan import LidarPairPlan
from coec.runtime.ingest.decoder import EGO, LIDAR, Frame
from coec.runtime.ingest.intake import Intake
from coec.runtime.ingest.sensor import SensorStream
from coec.runtime.ingest.sensor_clock import NS_PER_S
from coec.runtime.rig.keeper import RigEstimatorThread
from coec.runtime.rig.lidar_side import LidarPairReport, LidarPairStatus, Registration
from coec.runtime.worker import jobs
from coec.runtime.worker.jobs import JobOutcome, Registered
from coec.runtime.worker.supervisor import Worker

COUNTS_AFTER_NS = 15 * NS_PER_S
"""Sensor time from a look until it counts. A registration takes half a second, and may wait behind the solve of a
window."""

SWEEP_SETS_WAITING = 2
"""How many looks may wait for their turn, or for the answer to an earlier one."""

RESTS = 7
"""How many looks are left out after one that found next to nothing in common. Two LiDARs that do not overlap then cost
only an eighth. If they overlap after all, in a narrow street, that is noticed within two minutes."""

WEAK = Reason(
    "surroundings_tell_nothing",
    "What both see, such as open ground, tells no direction and no place better than it was known before.",
)

MISSED: Mapping[str, Reason] = {
    "standing": Reason("vehicle_stands", "The vehicle stands: it sees again what it saw."),
    "no_sweep": Reason("no_sweep", "There is no sweep of the one near in time to a sweep of the other."),
    "no_ego_motion": Reason("no_ego_motion", "There is no ego-motion with a velocity at the time of the sweeps."),
    "no_point_time": Reason(
        "no_point_time", "Points are not timed, and the vehicle moves: `lidar.sweep` says how they are measured."
    ),
}


@dataclass(slots=True, eq=False)
class _PendingRegistration:
    """A look that was asked for. `rests`: how many looks are left out after it, from its `due_ns` on; None until its
    answer has come."""

    due_ns: int
    start_ns: int
    stamp_ns: int
    losses: Mapping[str, int]
    rests: int | None = None


class LidarPairStream:
    """The looks at two LiDARs. Everything but `unanswered` belongs to the thread of the intake.

    Attributes:
        sensors: the streams of both LiDARs and of the vehicle's motion.
        unanswered: number of looks that were asked for and have no answer; for any thread.
    """

    def __init__(
        self,
        lidars: LidarPairPlan,
        period_s: float,
        intake: Intake,
        worker: Worker,
        budget: Budget,
        rig: RigEstimatorThread,
    ):
        a, b = lidars.a.pair, lidars.b.pair
        assert a.ego is not None
        self.sensors: Mapping[str, SensorStream] = {
            "a": intake.sensor(LIDAR, a.lidar),
            "b": intake.sensor(LIDAR, b.lidar),
            EGO: intake.sensor(EGO, a.ego),
        }
        self.unanswered = 0
        self._name = lidars.edge.name
        self._lidars = lidars.rig
        self._inbox = intake.inbox
        self._worker = worker
        self._budget = budget
        self._rig = rig
        self._sampler = SweepSampler(
            period_s,
            a.pairing.motion_tolerance_s,
            a.pairing.max_stamp_jump_s,
            a.window.min_speed_mps,
            timed_a=a.lidar.sweep is not None,
            timed_b=b.lidar.sweep is not None,
        )
        self._sweep_sets: deque[SweepSet] = deque()
        self._pending: deque[_PendingRegistration] = deque()
        self._losses: Counter[str] = Counter()
        self._resting = 0
        self._missed = ""
        self._tried_ns: int | None = None
        rig.join_lidars(LidarPairStatus(lidars.edge), lambda: self.unanswered == 0)
        budget.join_checks(self._name, period_s)
        intake.join(self)

    # --- frames -----------------------------------------------------------------------------------------------------

    def taker(self, name: str) -> Callable[[Frame], None]:
        """See `intake.Takes`."""
        return {"a": self._take_a, "b": self._take_b, EGO: self._take_motion}[name]

    def _take_a(self, frame: Frame) -> None:
        assert isinstance(frame, LidarFrame)
        before_ns = self._sampler.latest_ns
        sampled = self._sampler.push_a(frame)
        now_ns = self._sampler.latest_ns
        if now_ns == before_ns or now_ns is None:
            return
        if before_ns is not None and now_ns < before_ns:
            self._begin_new_time()
        self._hold(sampled)
        self._report_time(now_ns)

    def _take_b(self, frame: Frame) -> None:
        assert isinstance(frame, LidarFrame)
        self._hold(self._sampler.push_b(frame))

    def _take_motion(self, frame: Frame) -> None:
        assert isinstance(frame, EgoMotion)
        self._hold(self._sampler.push_motion(frame))

    def _hold(self, sampled: SampledSweeps) -> None:
        for one in sampled:
            if isinstance(one, MissedSweep):
                self._miss(one)
                continue
            self._missed = ""
            self._sweep_sets.append(one)
            if len(self._sweep_sets) > SWEEP_SETS_WAITING:
                self._sweep_sets.popleft()
                self._losses["superseded" if self._tried_ns is None else "not_afforded"] += 1
            self._tried_ns = None

    def _miss(self, missed: MissedSweep) -> None:
        """No look was possible; reports the cause to the rig if it is new."""
        if missed.cause != self._missed:
            self._missed = missed.cause
            report = LidarPairReport(missed.stamp_ns, None, (MISSED[missed.cause],), self._lost())
            self._rig.put(self._name, missed.stamp_ns + COUNTS_AFTER_NS, report)

    # --- turns ------------------------------------------------------------------------------------------------------

    def may_choose(self) -> bool:
        """Whether a look waits, every answer that counts before it has come, and the budget did not refuse it just
        now."""
        if not self._sweep_sets or self._tried_ns == self._sampler.latest_ns:
            return False
        stamp_ns = self._sweep_sets[0].stamp_ns
        return all(pending.rests is not None for pending in self._pending if pending.due_ns <= stamp_ns)

    def choose_next(self) -> bool:
        """Asks for the oldest waiting look, or leaves it out. Returns False if it still waits."""
        if not self.may_choose():
            return False
        sweep_set = self._sweep_sets[0]
        while self._pending and self._pending[0].due_ns <= sweep_set.stamp_ns:
            self._resting = self._pending.popleft().rests or 0
        if self._resting:
            self._resting -= 1
            self._losses["rested"] += 1
        elif self._budget.try_acquire(self._name, sweep_set.stamp_ns, suspected=False):
            self._submit(sweep_set)
        else:
            self._tried_ns = self._sampler.latest_ns
            return False
        self._sweep_sets.popleft()
        return True

    def tick(self, *, waiting: bool) -> None:
        """Does nothing: nothing here waits for a clock."""

    def _submit(self, sweep_set: SweepSet) -> None:
        pending = _PendingRegistration(
            sweep_set.stamp_ns + COUNTS_AFTER_NS, sweep_set.start_ns, sweep_set.stamp_ns, self._lost()
        )
        self._pending.append(pending)
        self.unanswered += 1

        def done(outcome: JobOutcome) -> None:
            self._budget.release(self._name)
            self._inbox.call(partial(self._answered, pending, outcome))

        self._worker.submit(jobs.register(self._name, self._lidars, sweep_set.pairs, done))

    # --- answers ----------------------------------------------------------------------------------------------------

    def _answered(self, pending: _PendingRegistration, outcome: JobOutcome) -> None:
        self.unanswered -= 1
        if pending not in self._pending:
            return  # it was asked before sensor time stepped back
        report, pending.rests = self._report_of(pending, outcome)
        self._rig.put(self._name, pending.due_ns, report)
        if self._sampler.latest_ns is not None:
            self._report_time(self._sampler.latest_ns)

    def _report_time(self, now_ns: int) -> None:
        waits = any(pending.rests is None and pending.due_ns <= now_ns for pending in self._pending)
        self._rig.report_time(self._name, now_ns, waits=waits)

    def _report_of(self, pending: _PendingRegistration, outcome: JobOutcome) -> tuple[LidarPairReport, int]:
        """The outcome of a look, and how many looks are to be left out after it."""
        answer = outcome.answer
        if not isinstance(answer, Registered):
            reasons = () if outcome.reason is None else (outcome.reason,)
            return LidarPairReport(pending.stamp_ns, None, reasons, pending.losses), 0
        if answer.reasons:
            rests = RESTS if answer.share < LEAST_SHARE else 0
            return LidarPairReport(pending.stamp_ns, None, answer.reasons, pending.losses), rests
        covariance = determined_covariance(answer.covariance)
        if covariance is None:
            return LidarPairReport(pending.stamp_ns, None, (WEAK,), pending.losses), 0
        registration = Registration(
            observation_of_registration(self._name, pending.stamp_ns, answer.T_a_b, covariance),
            EdgeWindow(window_of(pending.stamp_ns, answer.T_a_b, covariance), pending.start_ns),
            answer.range_bias,
            answer.rms_m,
            answer.points,
            answer.share,
        )
        return LidarPairReport(pending.stamp_ns, registration, (), pending.losses), 0

    # --- inside -----------------------------------------------------------------------------------------------------

    def _begin_new_time(self) -> None:
        """Sensor time has stepped back: drops all looks and questions, whose stamps mean nothing in the new time."""
        self._losses["time_stepped_back"] += len(self._pending) + len(self._sweep_sets)
        self._sweep_sets.clear()
        self._pending.clear()
        self._resting, self._missed, self._tried_ns = 0, "", None

    def _lost(self) -> dict[str, int]:
        return {cause: count for cause, count in (self._losses + self._sampler.losses).items() if count}
