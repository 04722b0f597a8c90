"""Two LiDARs on the thread of the intake: sweeps -> look -> worker -> report to the rig.

Only sensor time decides which sweeps are taken, and from when their result counts, so a replay of a drive gives the
same at any rate. The rig waits for everything that counts by its sensor time (`runtime.rig.order`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from coec.calibration.lidar_to_lidar.sampling import Found, Look, Missed, SweepSampler
from coec.calibration.lidar_to_lidar.types import LEAST_SHARE
from coec.calibration.rig.lidar_looks import look_of, told_by, window_of
from coec.calibration.rig.vehicle import Windowed
from coec.calibration.types import EgoMotion, LidarFrame, Reason
from coec.runtime.budget.budget import Budget
from coec.runtime.edges.plan import Planned
from coec.runtime.ingest.decoder import EGO, LIDAR, Frame
from coec.runtime.ingest.intake import Intake
from coec.runtime.ingest.sensor import SensorStream
from coec.runtime.ingest.sensor_clock import NS_PER_S
from coec.runtime.rig.keeper import RigKeeper
from coec.runtime.rig.lidar_side import LidarsKnown, LidarsSaid, Registration
from coec.runtime.worker import jobs
from coec.runtime.worker.jobs import JobOutcome, Registered
from coec.runtime.worker.supervisor import Worker

COUNTS_AFTER_NS = 15 * NS_PER_S
"""Sensor time from a look until it counts. A registration takes half a second, and may wait behind the solve of a
window."""

LOOKS_WAITING = 2
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
class _Question:
    """A look that was asked for. `rests`: how many looks are left out after it, from its `due_ns` on; None until its
    answer has come."""

    due_ns: int
    start_ns: int
    stamp_ns: int
    losses: Mapping[str, int]
    rests: int | None = None


class LidarEdgeStream:
    """The looks at two LiDARs. Everything but `unanswered` belongs to the thread of the intake.

    Attributes:
        sensors: the streams of both LiDARs and of the vehicle's motion.
        unanswered: number of looks that were asked for and have no answer; for any thread.
    """

    def __init__(
        self, lidars: Planned, period_s: float, intake: Intake, worker: Worker, budget: Budget, rig: RigKeeper
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
        self._looks: deque[Look] = deque()
        self._questions: deque[_Question] = deque()
        self._losses: Counter[str] = Counter()
        self._resting = 0
        self._missed = ""
        self._tried_ns: int | None = None
        rig.join_lidars(LidarsKnown(lidars.edge), lambda: self.unanswered == 0)
        budget.join_looks(self._name, period_s)
        intake.join(self)

    # --- frames -----------------------------------------------------------------------------------------------------

    def taker(self, name: str) -> Callable[[Frame], None]:
        """See `intake.Takes`."""
        return {"a": self._take_a, "b": self._take_b, EGO: self._take_motion}[name]

    def _take_a(self, frame: Frame) -> None:
        assert isinstance(frame, LidarFrame)
        before_ns = self._sampler.latest_ns
        found = self._sampler.push_a(frame)
        now_ns = self._sampler.latest_ns
        if now_ns == before_ns or now_ns is None:
            return
        if before_ns is not None and now_ns < before_ns:
            self._begin_new_time()
        self._hold(found)
        self._tell_time(now_ns)

    def _take_b(self, frame: Frame) -> None:
        assert isinstance(frame, LidarFrame)
        self._hold(self._sampler.push_b(frame))

    def _take_motion(self, frame: Frame) -> None:
        assert isinstance(frame, EgoMotion)
        self._hold(self._sampler.push_motion(frame))

    def _hold(self, found: Found) -> None:
        for one in found:
            if isinstance(one, Missed):
                self._miss(one)
                continue
            self._missed = ""
            self._looks.append(one)
            if len(self._looks) > LOOKS_WAITING:
                self._looks.popleft()
                self._losses["superseded" if self._tried_ns is None else "not_afforded"] += 1
            self._tried_ns = None

    def _miss(self, missed: Missed) -> None:
        """No look was possible; reports the cause to the rig if it is new."""
        if missed.cause != self._missed:
            self._missed = missed.cause
            said = LidarsSaid(missed.stamp_ns, None, (MISSED[missed.cause],), self._lost())
            self._rig.put(self._name, missed.stamp_ns + COUNTS_AFTER_NS, said)

    # --- turns ------------------------------------------------------------------------------------------------------

    def may_choose(self) -> bool:
        """Whether a look waits, every answer that counts before it has come, and the budget did not refuse it just
        now."""
        if not self._looks or self._tried_ns == self._sampler.latest_ns:
            return False
        stamp_ns = self._looks[0].stamp_ns
        return all(question.rests is not None for question in self._questions if question.due_ns <= stamp_ns)

    def choose_next(self) -> bool:
        """Asks for the oldest waiting look, or leaves it out. Returns False if it still waits."""
        if not self.may_choose():
            return False
        look = self._looks[0]
        while self._questions and self._questions[0].due_ns <= look.stamp_ns:
            self._resting = self._questions.popleft().rests or 0
        if self._resting:
            self._resting -= 1
            self._losses["rested"] += 1
        elif self._budget.affords(self._name, look.stamp_ns, suspected=False):
            self._ask(look)
        else:
            self._tried_ns = self._sampler.latest_ns
            return False
        self._looks.popleft()
        return True

    def tick(self, *, waiting: bool) -> None:
        """Does nothing: nothing here waits for a clock."""

    def _ask(self, look: Look) -> None:
        question = _Question(look.stamp_ns + COUNTS_AFTER_NS, look.start_ns, look.stamp_ns, self._lost())
        self._questions.append(question)
        self.unanswered += 1

        def done(outcome: JobOutcome) -> None:
            self._budget.ended(self._name)
            self._inbox.call(partial(self._answered, question, outcome))

        self._worker.ask(jobs.register(self._name, self._lidars, look.pairs, done))

    # --- answers ----------------------------------------------------------------------------------------------------

    def _answered(self, question: _Question, outcome: JobOutcome) -> None:
        self.unanswered -= 1
        if question not in self._questions:
            return  # it was asked before sensor time stepped back
        said, question.rests = self._said(question, outcome)
        self._rig.put(self._name, question.due_ns, said)
        if self._sampler.latest_ns is not None:
            self._tell_time(self._sampler.latest_ns)

    def _tell_time(self, now_ns: int) -> None:
        waits = any(question.rests is None and question.due_ns <= now_ns for question in self._questions)
        self._rig.at(self._name, now_ns, waits=waits)

    def _said(self, question: _Question, outcome: JobOutcome) -> tuple[LidarsSaid, int]:
        """The outcome of a look, and how many looks are to be left out after it."""
        answer = outcome.answer
        if not isinstance(answer, Registered):
            reasons = () if outcome.reason is None else (outcome.reason,)
            return LidarsSaid(question.stamp_ns, None, reasons, question.losses), 0
        if answer.reasons:
            rests = RESTS if answer.share < LEAST_SHARE else 0
            return LidarsSaid(question.stamp_ns, None, answer.reasons, question.losses), rests
        covariance = told_by(answer.covariance)
        if covariance is None:
            return LidarsSaid(question.stamp_ns, None, (WEAK,), question.losses), 0
        registration = Registration(
            look_of(self._name, question.stamp_ns, answer.T_a_b, covariance),
            Windowed(window_of(question.stamp_ns, answer.T_a_b, covariance), question.start_ns),
            answer.range_bias,
            answer.rms_m,
            answer.points,
            answer.share,
        )
        return LidarsSaid(question.stamp_ns, registration, (), question.losses), 0

    # --- inside -----------------------------------------------------------------------------------------------------

    def _begin_new_time(self) -> None:
        """Sensor time has stepped back: drops all looks and questions, whose stamps mean nothing in the new time."""
        self._losses["time_stepped_back"] += len(self._questions) + len(self._looks)
        self._looks.clear()
        self._questions.clear()
        self._resting, self._missed, self._tried_ns = 0, "", None

    def _lost(self) -> dict[str, int]:
        return {cause: count for cause, count in (self._losses + self._sampler.losses).items() if count}
