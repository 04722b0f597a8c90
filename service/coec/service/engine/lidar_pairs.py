"""Registers the LiDARs of a vehicle against each other: plans which two of them are registered, takes their sweeps on
the thread of the engine, submits a registration to the worker, and reports its result to the rig.

Only sensor time decides which sweeps are taken, and from when their result counts, so a replay of a drive gives the
same at any rate. The rig waits for everything that counts by its sensor time (`schedule`).
"""

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from math import inf

import numpy as np

from coec.calibration.rig import lidar_sampling, nearest_neighbours
from coec.calibration.rig.edge_observations import determined_covariance, observation_of_registration, window_of
from coec.calibration.rig.graph import Edge
from coec.calibration.rig.rig_estimator import EdgeWindow
from coec.calibration.types import NS_PER_S, EgoMotion, Frame, LidarFrame, Matrix4, Reason, Rig
from coec.config import LidarEdgesConfig, PairConfig
from coec.io.rig_files import rig_of
from coec.service.engine.messages import JobDone
from coec.service.engine.rig import (
    LidarPairReport,
    LidarPairStatus,
    LidarState,
    Registration,
    graph_of,
    sensors_of,
)
from coec.service.engine.schedule import Request, Schedule
from coec.service.engine.vehicle import Vehicle
from coec.service.ingest.decoder import EGO, LIDAR, SensorStream, Taker
from coec.service.worker import worker_jobs
from coec.service.worker.supervisor import Worker

MAX_LIDAR_PAIRS = 6
"""How many combinations of two LiDARs are looked at, in the order of the configuration: all those of four LiDARs. Each
holds some twenty sweeps."""

NOT_INSTALLED = Reason(
    "lidars_not_installed",
    "Not measured: the extra lidars is not installed. Add it (pip install 'coec[lidars]'), or set "
    "`lidar_edges.period_s: 0`.",
)
SWITCHED_OFF = Reason("switched_off", "Not measured: `lidar_edges.period_s` is 0.")
NO_EGO = Reason(
    "no_ego_motion",
    "Not measured: no `ego` is configured, and without ego-motion two sweeps of a moving vehicle are not of one "
    "instant.",
)
NOT_JOINED = Reason(
    "no_nominal_pose", "Not measured: no cameras and links connect the two, so their nominal relative pose is unknown."
)
TOO_MANY = Reason("too_many", f"Not measured: {MAX_LIDAR_PAIRS} pairs of LiDARs are registered, and this is one more.")


@dataclass(frozen=True, slots=True, eq=False)
class LidarOfPair:
    """A LiDAR of a vehicle: its name, a pair that has it, and the rig of that pair."""

    name: str
    pair: PairConfig
    rig: Rig


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairPlan:
    """Two LiDARs.

    Attributes:
        edge: the edge between them, with the pose as built.
        why_not: why they are not looked at; None if they are.
    """

    edge: Edge
    a: LidarOfPair
    b: LidarOfPair
    why_not: Reason | None

    @property
    def rig(self) -> lidar_sampling.LidarRig:
        """The two LiDARs as input of a registration."""
        a, b = self.a, self.b
        return lidar_sampling.LidarRig(a.name, b.name, self.edge.T_a_b, a.rig.T_lidar_ego, a.rig.sweep, b.rig.sweep)


def plan_lidar_pairs(pairs: Iterable[PairConfig], period_s: float) -> tuple[LidarPairPlan, ...]:
    """Every two LiDARs of the pairs. The one that comes first in the configuration is a; if one LiDAR is larger, people
    name it first.

    Raises:
        ConfigError: the rig of a pair cannot be built.
    """
    rigs = {pair.name: (pair, rig_of(pair)) for pair in pairs}
    lidars: dict[str, LidarOfPair] = {}
    for pair, rig in rigs.values():
        name = sensors_of(pair)[1]
        lidars.setdefault(name, LidarOfPair(name, pair, rig))
    if len(lidars) < 2:
        return ()
    places = _places({name: (pair, rig.T_camera_lidar_nominal) for name, (pair, rig) in rigs.items()})
    plans: list[LidarPairPlan] = []
    for a, b in combinations(lidars.values(), 2):
        T_a_b = places.get(b.name, {}).get(a.name)
        edge = Edge(f"{a.name} to {b.name}", a.name, b.name, np.eye(4) if T_a_b is None else T_a_b)
        why_not = NOT_JOINED if T_a_b is None else _why_not(a, period_s)
        if why_not is None and sum(one.why_not is None for one in plans) >= MAX_LIDAR_PAIRS:
            why_not = TOO_MANY
        plans.append(LidarPairPlan(edge, a, b, why_not))
    return tuple(plans)


def _places(pairs: Mapping[str, tuple[PairConfig, Matrix4]]) -> dict[str, Mapping[str, Matrix4]]:
    """T_sensor_origin (4, 4) by origin and sensor, for sensors that are joined by pairs; empty if there are more
    sensors than a rig may have."""
    try:
        graph = graph_of(pairs, ())
    except ValueError:
        return {}
    return {sensor.name: graph.joined_to(sensor.name) for sensor in graph.sensors}


def _why_not(a: LidarOfPair, period_s: float) -> Reason | None:
    if period_s == 0.0:
        return SWITCHED_OFF
    if not nearest_neighbours.installed():
        return NOT_INSTALLED
    return NO_EGO if a.pair.ego is None else None


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
    "The surfaces that both measure, such as open ground, determine no axis better than it was known before.",
)

MISSED: Mapping[str, Reason] = {
    "standing": Reason("vehicle_stands", "The vehicle stands, so its sweeps repeat."),
    "no_sweep": Reason("no_sweep", "No sweep of one LiDAR is near in time to a sweep of the other."),
    "no_ego_motion": Reason("no_ego_motion", "No ego-motion with a velocity covers the time of the sweeps."),
    "no_point_time": Reason("no_point_time", "Points have no time, and the vehicle moves: set `lidar.sweep`."),
}


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationSubject:
    """The sweeps of a registration: of the first and the last one, and what was lost before them."""

    start_ns: int
    stamp_ns: int
    losses: Mapping[str, int]


RegistrationRequest = Request[RegistrationSubject, worker_jobs.JobOutcome, int]
"""What a registration changes is how many are left out after it."""


class LidarPairStream:
    """The registrations of two LiDARs. Everything belongs to the thread of the engine.

    Attributes:
        sensors: the streams of both LiDARs and of the vehicle's motion.
    """

    def __init__(self, lidars: LidarPairPlan, period_s: float, vehicle: Vehicle, worker: Worker):
        a, b = lidars.a.pair, lidars.b.pair
        assert a.ego is not None
        self.sensors: Mapping[str, SensorStream] = {
            "a": vehicle.sensor(LIDAR, a.lidar),
            "b": vehicle.sensor(LIDAR, b.lidar),
            EGO: vehicle.sensor(EGO, a.ego),
        }
        self._name = lidars.edge.name
        self._lidars = lidars.rig
        self._vehicle = vehicle
        self._worker = worker
        self._sampler = lidar_sampling.SweepSampler(
            period_s,
            a.pairing.motion_tolerance_s,
            a.pairing.max_stamp_jump_s,
            a.window.min_speed_mps,
            timed_a=a.lidar.sweep is not None,
            timed_b=b.lidar.sweep is not None,
        )
        self._sweep_sets: deque[lidar_sampling.SweepSet] = deque()
        self._schedule: Schedule[RegistrationSubject, worker_jobs.JobOutcome, int] = Schedule()
        self._losses: Counter[str] = Counter()
        self._resting = 0
        self._missed = ""
        self._tried_ns: int | None = None
        vehicle.rig.join_lidars(LidarPairStatus(lidars.edge))
        vehicle.budget.join_checks(self._name, period_s)
        vehicle.join(self)

    @property
    def name(self) -> str:
        """Name of the edge between the two."""
        return self._name

    @property
    def unanswered(self) -> int:
        """Number of registrations that were requested and have no result."""
        return self._schedule.unanswered

    @property
    def oldest_request(self) -> RegistrationRequest | None:
        """The request whose result is to be concluded next; None if there is none."""
        return self._schedule.oldest

    @property
    def is_waiting(self) -> bool:
        """Whether a result that counts by the newest sweep is missing."""
        return self._sampler.latest_ns is not None and self._schedule.waits(self._sampler.latest_ns)

    # --- frames -----------------------------------------------------------------------------------------------------

    def taker(self, name: str) -> Taker:
        """The function that takes the frames of one of its streams."""
        return {"a": self._take_a, "b": self._take_b, EGO: self._take_motion}[name]

    def _take_a(self, frame: Frame, _: float) -> None:
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

    def _take_b(self, frame: Frame, _: float) -> None:
        assert isinstance(frame, LidarFrame)
        self._hold(self._sampler.push_b(frame))

    def _take_motion(self, frame: Frame, _: float) -> None:
        assert isinstance(frame, EgoMotion)
        self._hold(self._sampler.push_motion(frame))

    def _hold(self, sampled: lidar_sampling.SampledSweeps) -> None:
        for one in sampled:
            if isinstance(one, lidar_sampling.MissedSweep):
                self._miss(one)
                continue
            self._missed = ""
            self._sweep_sets.append(one)
            if len(self._sweep_sets) > SWEEP_SETS_WAITING:
                self._sweep_sets.popleft()
                self._losses["superseded" if self._tried_ns is None else "not_afforded"] += 1
            self._tried_ns = None

    def _miss(self, missed: lidar_sampling.MissedSweep) -> None:
        """No look was possible; reports the cause to the rig if it is new."""
        if missed.cause != self._missed:
            self._missed = missed.cause
            report = LidarPairReport(missed.stamp_ns, None, (MISSED[missed.cause],), self._lost())
            self._vehicle.rig.put(self._name, missed.stamp_ns + COUNTS_AFTER_NS, report)

    # --- turns ------------------------------------------------------------------------------------------------------

    def advance(self, now_s: float) -> bool:
        """Requests the oldest waiting registration, or leaves it out. Returns whether it could: a result that counts
        before it may be missing, or the budget refuses it until the streams have gone on."""
        del now_s
        if not self._sweep_sets or self._tried_ns == self._sampler.latest_ns:
            return False
        sweep_set = self._sweep_sets[0]
        if self._schedule.waits(sweep_set.stamp_ns):
            return False
        for rests in self._schedule.take_due(sweep_set.stamp_ns):
            self._resting = rests
        if self._resting:
            self._resting -= 1
            self._losses["rested"] += 1
        elif self._vehicle.budget.try_acquire(self._name, sweep_set.stamp_ns, suspected=False):
            self._submit(sweep_set)
        else:
            self._tried_ns = self._sampler.latest_ns
            return False
        self._sweep_sets.popleft()
        return True

    def tick(self, now_s: float, *, waiting: bool) -> None:
        """Nothing here waits for a clock: the worker answers every job by its deadline."""

    def _submit(self, sweep_set: lidar_sampling.SweepSet) -> None:
        subject = RegistrationSubject(sweep_set.start_ns, sweep_set.stamp_ns, self._lost())
        request = self._schedule.submit(subject, sweep_set.stamp_ns + COUNTS_AFTER_NS, inf)
        done = partial(self._vehicle.post_outcome, self._name, request)
        self._worker.submit(worker_jobs.register(self._name, self._lidars, sweep_set.pairs, done))

    # --- results ----------------------------------------------------------------------------------------------------

    def on_event(self, event: object) -> None:
        """A registration has ended."""
        assert isinstance(event, JobDone)
        assert isinstance(event.subject, Request)
        self._vehicle.budget.release(self._name)
        # One that was requested before sensor time stepped back does not count.
        self._schedule.answer(event.subject, event.outcome)
        while (request := self._schedule.next_answered()) is not None:
            report, rests = self._report_of(request)
            self._schedule.conclude(request, rests)
            self._vehicle.rig.put(self._name, request.due_ns, report)
        if self._sampler.latest_ns is not None:
            self._report_time(self._sampler.latest_ns)

    def _report_time(self, now_ns: int) -> None:
        self._vehicle.rig.report_time(self._name, now_ns, waits=self._schedule.waits(now_ns))

    def _report_of(self, request: RegistrationRequest) -> tuple[LidarPairReport, int]:
        """The outcome of a registration, and how many are to be left out after it."""
        subject, outcome = request.subject, request.result
        assert outcome is not None
        answer = outcome.answer
        if not isinstance(answer, worker_jobs.Registered):
            reasons = () if outcome.reason is None else (outcome.reason,)
            return LidarPairReport(subject.stamp_ns, None, reasons, subject.losses), 0
        if answer.reasons:
            rests = RESTS if answer.share < lidar_sampling.LEAST_SHARE else 0
            return LidarPairReport(subject.stamp_ns, None, answer.reasons, subject.losses), rests
        covariance = determined_covariance(answer.covariance)
        if covariance is None:
            return LidarPairReport(subject.stamp_ns, None, (WEAK,), subject.losses), 0
        registration = Registration(
            observation_of_registration(self._name, subject.stamp_ns, answer.T_a_b, covariance),
            EdgeWindow(window_of(subject.stamp_ns, answer.T_a_b, covariance), subject.start_ns),
            answer.range_bias,
            answer.rms_m,
            answer.points,
            answer.share,
        )
        return LidarPairReport(subject.stamp_ns, registration, (), subject.losses), 0

    # --- inside -----------------------------------------------------------------------------------------------------

    def _begin_new_time(self) -> None:
        """Sensor time has stepped back: drops all sweeps and requests, whose stamps mean nothing in the new time."""
        self._losses["time_stepped_back"] += self._schedule.withdraw() + len(self._sweep_sets)
        self._sweep_sets.clear()
        self._resting, self._missed, self._tried_ns = 0, "", None

    def _lost(self) -> dict[str, int]:
        return {cause: count for cause, count in (self._losses + self._sampler.losses).items() if count}


class LidarPairs:
    """The edges between all LiDARs of a vehicle. For the main thread.

    Attributes:
        streams: registrations of the LiDARs that can be registered.
        problem: why no LiDARs are registered, if people can change that; else None.
    """

    def __init__(self, config: LidarEdgesConfig, vehicle: Vehicle, worker: Worker) -> None:
        self._period_s = config.period_s
        self._vehicle = vehicle
        self._worker = worker
        self._names: set[str] = set()
        self.streams: list[LidarPairStream] = []
        self.problem: Reason | None = None

    def grow(self, pairs: Iterable[PairConfig]) -> None:
        """Takes all present pairs, which the rig knows already, and begins to register every two of their LiDARs that
        are new.

        Raises:
            ConfigError: the rig of a pair cannot be built.
        """
        for lidars in plan_lidar_pairs(pairs, self._period_s):
            if lidars.edge.name in self._names:
                continue
            self._names.add(lidars.edge.name)
            why_not = lidars.why_not
            if why_not is None:
                self.streams.append(LidarPairStream(lidars, self._period_s, self._vehicle, self._worker))
                continue
            self._vehicle.rig.join_lidars(LidarPairStatus(lidars.edge, LidarState.NOT_MEASURED, (why_not,)))
            if why_not is NOT_INSTALLED:
                self.problem = why_not
