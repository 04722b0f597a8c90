"""Puts together what the pairs of a vehicle report, and what the rig exchanges with each pair and with every two
LiDARs. Reports are taken in one order (`schedule`). What the rig reports to a pair counts `LAG_NS` later in the
selection of the pair's frames, and the frames wait for it. So it changes the same things at the same sensor time, in
whatever order the streams of the pairs come. When a sensor was identified as moved, one correction for all its pairs
waits for a window of each. A pair that suspects nothing itself would end its window minutes later, with its ordinary
slice, so windows of these pairs are requested.

Everything here belongs to the thread of the engine; only `join` and `join_lidars` are for any thread.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import radians
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.change_detector import Observation, new_share
from coec.calibration.rig import rig_estimator
from coec.calibration.rig.edge_observations import EdgeObservation, observation_of_check
from coec.calibration.rig.graph import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.rig.lidar_sampling import KNOWN_BEFORE, RangeBias
from coec.calibration.rig.rig_estimator import EdgeWindow, JointPose, ServedEdge, VehicleRig, pairs_of
from coec.calibration.state import PairState
from coec.calibration.tracker import Measurement, prior_sigma
from coec.calibration.types import NS_PER_S, Estimate, Matrix4, Reason
from coec.config import LinkConfig, PairConfig
from coec.io.disk_writer import DiskWriter
from coec.service.engine.schedule import NEVER_NS, ReportSchedule
from coec.service.recording.window_store import start_ns_of
from coec.service.records.rig_store import RigStore


@dataclass(frozen=True, slots=True)
class WindowRequest:
    """A window of a pair is wanted.

    Attributes:
        since_ns: only frames since this sensor time are wanted; earlier ones show the mount before the move.
        from_ns: sensor time from which the wish counts.
    """

    since_ns: int
    from_ns: int


def window_requests(before: VehicleRig | None, rig: VehicleRig | None, from_ns: int) -> Mapping[str, WindowRequest]:
    """The new wishes, by pair: those that hold for `rig` and did not for `before`. They count from `from_ns` on."""
    if rig is None or rig.event is None:
        return {}
    known = _pairs_without_window(before)
    return {
        name: WindowRequest(rig.event.stepped_ns, from_ns) for name in _pairs_without_window(rig) if name not in known
    }


def _pairs_without_window(rig: VehicleRig | None) -> tuple[str, ...]:
    """Pairs of the moved sensors without a window since the move, until the sensors are put right. Edges between LiDARs
    are left out: they have no windows, but are registered at their own times."""
    if rig is None or rig.event is None or rig.event.corrected:
        return ()
    pairs = pairs_of(rig.graph, rig.event.sensors)
    return tuple(name for name in pairs if name not in rig.windows and name not in rig.graph.of_lidars)


def graph_of(
    pairs: Mapping[str, tuple[PairConfig, Matrix4]], links: Sequence[LinkConfig], of_lidars: Sequence[Edge] = ()
) -> RigGraph:
    """The graph of pairs by name, each with its nominal calibration (4, 4), and of edges between their LiDARs. Edges
    and links of sensors that no pair has yet are left out.

    Raises:
        ValueError: there are more sensors than a rig may have.
    """
    sensors: dict[str, Sensor] = {}
    edges = []
    for name, (pair, T_camera_lidar) in pairs.items():
        camera, lidar = sensors_of(pair)
        sensors |= {camera: Sensor(camera, SensorKind.CAMERA), lidar: Sensor(lidar, SensorKind.LIDAR)}
        edges.append(Edge(name, camera, lidar, T_camera_lidar))
    edges += [edge for edge in of_lidars if {edge.a, edge.b} <= set(sensors)]
    rigid = [_link(link) for link in links]
    return RigGraph.of(list(sensors.values()), edges, [link for link in rigid if {link.a, link.b} <= set(sensors)])


def sensors_of(pair: PairConfig) -> tuple[str, str]:
    """Names of a pair's camera and LiDAR; they are the same in every pair that shares the sensor."""
    camera, lidar = pair.camera.sensor, pair.lidar.sensor
    return camera, f"{lidar} (LiDAR)" if lidar == camera else lidar


def _link(link: LinkConfig) -> RigidLink:
    a, b = link.ends
    sigma = np.array([radians(link.sigma_deg)] * 3 + [link.sigma_m] * 3)
    return RigidLink(f"link {a} {b}", a, b, np.array(link.T_a_b), sigma)


PairReport = EdgeObservation | EdgeWindow | ServedEdge
"""What a pair may report."""


@dataclass(frozen=True, slots=True, eq=False)
class PairCorrection:
    """A correction of one pair, which was decided at a sensor time together with those of the other pairs.

    Attributes:
        from_ns: sensor time from which it counts.
        text: why, in one sentence.
    """

    joint_pose: JointPose
    stamp_ns: int
    from_ns: int
    text: str


class RigMember:
    """One pair of the rig: what it reports, and what the rig reports to it."""

    def __init__(self, pair: PairConfig, rig: RigEstimator) -> None:
        self._name = pair.name
        self._prior = prior_sigma(pair.tracker)
        self._rig = rig

    def on_check(self, due_ns: int, before: PairState, after: PairState, observation: Observation) -> None:
        """A check of the extrinsic that was served `before` was completed."""
        share = new_share(before.monitor, observation)
        edge_observation = observation_of_check(
            self._name, before.T_camera_lidar, observation, share, after.flagged_since_ns
        )
        if edge_observation is not None:
            self._rig.put(self._name, due_ns, edge_observation)

    def accepted(self, due_ns: int | None, estimate: Estimate) -> None:
        """A window was accepted."""
        self._rig.put(
            self._name, due_ns, EdgeWindow(Measurement.from_estimate(estimate), start_ns_of(estimate.window_id))
        )

    def serves(self, due_ns: int | None, state: PairState) -> None:
        """Another extrinsic is served from now on."""
        self._rig.put(self._name, due_ns, served_by(state, self._prior))

    def report_time(self, stamp_ns: int, *, waits: bool) -> None:
        """The pair has frames of this sensor time. If it `waits`, results of its own requests are missing; else it has
        made all its reports up to there."""
        self._rig.report_time(self._name, stamp_ns, waits=waits)

    def waits(self, stamp_ns: int) -> bool:
        """Whether the rig may still report something that counts before a frame pair of this stamp is evaluated."""
        return self._rig.waits(stamp_ns)

    def corrections(self, stamp_ns: int) -> list[PairCorrection]:
        """Corrections that count before a frame pair of this stamp is evaluated; each is returned once."""
        return self._rig.corrections(self._name, stamp_ns)

    def pop_window_request(self, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants frame pairs for a window, before a pair of this stamp is evaluated;
        returned once. None: it wants no window."""
        return self._rig.pop_window_request(self._name, stamp_ns)

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""
        self._rig.step_back(stamp_ns)


def served_by(state: PairState, prior: NDArray[np.float64]) -> ServedEdge:
    """What a pair serves; `prior` (6,) is how far the nominal calibration may be off (rad, m)."""
    pose: Matrix4 = state.T_camera_lidar
    if state.accepted is None:
        return ServedEdge(pose, prior, None)
    track = state.track
    known = (
        None
        if track is None or not track.windows
        else Measurement(track.T_camera_lidar, track.uncertainty, track.stamp_ns)
    )
    return ServedEdge(pose, state.accepted.sigma, start_ns_of(state.accepted.window_id), known)


class LidarState(StrEnum):
    """State of two LiDARs. `not_measured`: nothing ever looks at them. `waiting`: nothing has looked at them yet.
    `measured`: the latest look gives the pose of one in the other. `refused`: it does not, or no look was possible."""

    NOT_MEASURED = "not_measured"
    WAITING = "waiting"
    MEASURED = "measured"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The result of a registration of two LiDARs a and b.

    Attributes:
        observation: the pose of b in a, as evidence of which sensor moved.
        window: the same for the joint estimate.
        range_bias: by how much b measures longer ranges than a.
        rms_m: distance of the points of b from the surfaces of a.
        points, share: number and share of the points of b that met a surface.
    """

    observation: EdgeObservation
    window: EdgeWindow
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairReport:
    """The outcome of a registration, or of the sweeps that should have given one.

    Attributes:
        stamp_ns: stamp of the last sweep of the registration.
        registration: the result; None if the registration was refused.
        reasons: why it was refused; empty exactly if it was not.
        losses: number of sweeps and registrations that were lost so far, by cause.
    """

    stamp_ns: int
    registration: Registration | None
    reasons: tuple[Reason, ...]
    losses: Mapping[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairStatus:
    """Everything that is known of two LiDARs.

    Attributes:
        edge: the two LiDARs and their pose as built.
        state: see `LidarState`.
        reasons: reasons for the state; empty if they are measured.
        stamp_ns: stamp of the latest registration that was done or refused; None before the first.
        registration: result of the latest one that was not refused.
        registrations: number of registrations that had a result.
        losses: see `LidarPairReport`.
    """

    edge: Edge
    state: LidarState = LidarState.WAITING
    reasons: tuple[Reason, ...] = ()
    stamp_ns: int | None = None
    registration: Registration | None = None
    registrations: int = 0
    losses: Mapping[str, int] = field(default_factory=dict)

    def after(self, report: LidarPairReport) -> LidarPairStatus:
        """This knowledge with the outcome of one more look."""
        known = replace(self, stamp_ns=report.stamp_ns, reasons=report.reasons, losses=report.losses)
        if report.registration is None:
            return replace(known, state=LidarState.REFUSED)
        return replace(
            known, state=LidarState.MEASURED, registration=report.registration, registrations=self.registrations + 1
        )


_log = logging.getLogger(__name__)

LAG_NS = 15 * NS_PER_S
"""Sensor time from a report of a pair until what the rig tells the pairs counts. If the windows of one pair take the
worker so long that the pair is this far behind another, it holds the other up."""

QUIET_TICKS = 4
"""Ticks without a frame of any pair after which, once every request is answered, all reports are taken: nothing earlier
can come. Ticks are counted instead of seconds, because a process that slept has samples to take first."""

MOST_CORRECTIONS = 4
"""How many corrections of one pair may wait for its frames. If a pair has no frames, the newest ones stay."""

SAVE_NS = 60 * NS_PER_S
"""Sensor time between two savings while nothing happens. If the process is killed, a minute of looks is lost."""

ONE_PAIR = Reason(
    "one_pair", "One pair cannot distinguish a move of its camera from one of its LiDAR; see its `health`."
)


@dataclass(frozen=True, slots=True, eq=False)
class RigSnapshot:
    """Everything that is known of the rig at one moment, from which the answers are made.

    Attributes:
        graph: the sensors and pairs; None before the first pair.
        rig: what is known of the rig; None while there is none, and then `why` says why.
        stamp_ns: everything that counts up to this sensor time is included; None before anything is.
        from_ns: sensor time from which the latest correction counts.
        lidars: every two LiDARs.
        losses: number of losses, by cause.
    """

    graph: RigGraph | None = None
    rig: VehicleRig | None = None
    why: tuple[Reason, ...] = ()
    stamp_ns: int | None = None
    from_ns: int | None = None
    lidars: tuple[LidarPairStatus, ...] = ()
    losses: Mapping[str, int] = field(default_factory=dict)


class _SteppedBack:
    """Report that sensor time has stepped back."""


@dataclass(frozen=True, slots=True, eq=False)
class _Joined:
    """A new pair."""

    config: PairConfig
    nominal: Matrix4
    serves: ServedEdge
    window: EdgeWindow | None


class RigEstimator:
    """The rig of one vehicle.

    Attributes:
        snapshot: what is known; replaced whenever it has changed, and never changed itself.
        has_news: something has come since `take_report` last had nothing to take.
    """

    def __init__(self, folder: Path, links: Sequence[LinkConfig], disk_writer: DiskWriter) -> None:
        self._links = tuple(links)
        self._disk_writer = disk_writer
        self._file = RigStore(folder)
        disk_writer.register(self._file)
        self._schedule: ReportSchedule[PairReport | LidarPairReport | LidarPairStatus | _Joined | _SteppedBack] = (
            ReportSchedule()
        )
        self._joining: deque[tuple[str, _Joined | LidarPairStatus]] = deque()
        self._corrections: dict[str, deque[PairCorrection]] = {}
        self._window_requests: dict[str, WindowRequest] = {}
        self._pairs: dict[str, _Joined] = {}
        self._lidars: dict[str, LidarPairStatus] = {}
        self._members = 0
        self._quiet_ticks = 0
        self._rig: VehicleRig | None = None
        self._graph: RigGraph | None = None
        self._why: tuple[Reason, ...] = ()
        self._from_ns: int | None = None
        self._losses: Counter[str] = Counter({"state_damaged": len(self._file.damage)} if self._file.damage else {})
        self._saved_ns = NEVER_NS
        self.snapshot = RigSnapshot(losses=dict(self._losses))
        self.has_news = True

    # --- on any thread ----------------------------------------------------------------------------------------------

    def join(self, pair: PairConfig, nominal: Matrix4, state: PairState) -> RigMember:
        """Adds a pair to the rig: with its nominal calibration (4, 4) and its state at the start."""
        accepted = state.accepted
        window = (
            None
            if accepted is None
            else EdgeWindow(Measurement.from_estimate(accepted), start_ns_of(accepted.window_id))
        )
        self.has_news = True
        self._joining.append((pair.name, _Joined(pair, nominal, served_by(state, prior_sigma(pair.tracker)), window)))
        return RigMember(pair, self)

    def join_lidars(self, known: LidarPairStatus) -> None:
        """Adds two LiDARs of pairs that have joined, whether they are registered or not. The name of their edge stands
        for them. The edge belongs to the rig once a registration has measured it."""
        self._joining.append((known.edge.name, known))
        self.has_news = True

    # --- reports ----------------------------------------------------------------------------------------------------

    def put(self, pair: str, due_ns: int | None, report: PairReport | LidarPairReport) -> None:
        """Takes in a report of a pair that counts from a sensor time on (None: from now on)."""
        self._admit()
        if self._members < 2:
            if isinstance(report, EdgeObservation):
                return
            due_ns = None  # there is no other pair whose report it could overtake
        self._schedule.put(pair, due_ns, report)
        self.has_news = True

    def report_time(self, pair: str, stamp_ns: int, *, waits: bool) -> None:
        """A pair has frames of this sensor time. If it `waits`, results of its own requests are missing; else it has
        made all its reports up to there."""
        self._admit()
        if self._members >= 2:
            self._quiet_ticks, self.has_news = 0, True
            self._schedule.report_time(pair, stamp_ns, waits=waits)

    def waits(self, stamp_ns: int) -> bool:
        """Whether the rig may still report something that counts by this sensor time."""
        return self._members >= 2 and self._schedule.taken_ns < stamp_ns - LAG_NS

    def step_back(self, stamp_ns: int) -> None:
        """Sensor time has stepped back for a pair, to this stamp."""
        if self._members < 2:
            return
        self._schedule.step_back(stamp_ns, _SteppedBack())
        self.has_news = True
        for waiting in self._corrections.values():
            waiting.clear()
        self._window_requests.clear()

    def corrections(self, pair: str, stamp_ns: int) -> list[PairCorrection]:
        """Corrections of a pair that count from this sensor time or an earlier one; each is returned once."""
        waiting = self._corrections.get(pair)
        due = []
        while waiting and waiting[0].from_ns <= stamp_ns:
            due.append(waiting.popleft())
        return due

    def pop_window_request(self, pair: str, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants frame pairs for a window, if that counts by `stamp_ns`; returned
        once."""
        request = self._window_requests.get(pair)
        if request is None or request.from_ns > stamp_ns:
            return None
        del self._window_requests[pair]
        return request.since_ns

    # --- turns of the engine ----------------------------------------------------------------------------------------

    def tick(self) -> None:
        """A second has passed."""
        self._quiet_ticks += 1
        self.has_news = True

    @property
    def is_quiet(self) -> bool:
        """Whether no pair has had a frame for `QUIET_TICKS`."""
        return self._quiet_ticks >= QUIET_TICKS

    def take_report(self, *, all_are_silent: bool = False) -> bool:
        """Takes the next report; returns whether one could be taken. `all_are_silent`: nothing earlier can come,
        because the streams have stopped and every request is answered."""
        self._admit()
        self.has_news = self._take_one(silent=all_are_silent)
        return self.has_news

    def finish(self) -> None:
        """Takes all reports in their order, and saves what is known; for the end of the service."""
        self._admit()
        while self._take_one(silent=True):
            pass
        self._save()

    def _admit(self) -> None:
        """Takes in whoever has joined."""
        while self._joining:
            name, joined = self._joining.popleft()
            self._members += isinstance(joined, _Joined)
            self._schedule.put(name, None, joined)

    def _take_one(self, *, silent: bool) -> bool:
        report = self._schedule.take(all_are_silent=silent)
        if report is None:
            return False
        before = self._rig
        try:
            self._after(report.pair, report.due_ns, report.what)
        except ValueError as error:  # unusable numbers, from an estimate that went wrong
            self._losses["refused"] += 1
            _log.warning(f"what {report.pair} reported is excluded from the rig estimate: {error}")
        self._notify_pairs(before, report.due_ns)
        self._schedule.finish(report)
        self._save_in_time(before, report.due_ns)
        self.snapshot = self._snapshot()
        return True

    def _after(
        self, pair: str, due_ns: int, what: PairReport | LidarPairReport | LidarPairStatus | _Joined | _SteppedBack
    ) -> None:
        if isinstance(what, _Joined):
            self._pairs[pair] = what
            self._grow()
        elif isinstance(what, LidarPairStatus):
            self._lidars[pair] = what
        elif isinstance(what, LidarPairReport):
            self._after_lidars(pair, what)
        elif self._rig is None:
            self._meanwhile(pair, what)
        elif isinstance(what, _SteppedBack):
            self._rig = rig_estimator.forgotten(self._rig)
        elif isinstance(what, EdgeObservation):
            self._rig = rig_estimator.after_edge_observation(self._rig, what)
        elif isinstance(what, EdgeWindow):
            self._rig = rig_estimator.after_window(self._rig, pair, what, due_ns)
        else:
            self._rig = rig_estimator.after_served(self._rig, pair, what, due_ns)

    def _after_lidars(self, name: str, report: LidarPairReport) -> None:
        self._lidars[name] = self._lidars[name].after(report)
        if report.registration is None or self._rig is None:
            return
        if name not in self._rig.graph.edge:
            self._grow()
        if self._rig is not None and name in self._rig.graph.edge:
            self._rig = rig_estimator.after_lidars(
                self._rig, report.registration.observation, report.registration.window
            )

    def _meanwhile(self, pair: str, what: PairReport | _SteppedBack) -> None:
        """While there is no rig, keeps what a pair serves and its window."""
        if isinstance(what, ServedEdge):
            self._pairs[pair] = replace(self._pairs[pair], serves=what)
        elif isinstance(what, EdgeWindow):
            self._pairs[pair] = replace(self._pairs[pair], window=what)

    def _grow(self) -> None:
        """Builds the rig anew, after one more pair or one more edge between two LiDARs."""
        measured = [known.edge for known in self._lidars.values() if known.registrations]
        try:
            configured = {name: (joined.config, joined.nominal) for name, joined in self._pairs.items()}
            self._graph = graph_of(configured, self._links, measured)
        except ValueError as error:
            self._rig, self._why = None, (Reason("no_rig", f"The pairs cannot be combined: {error}."),)
            return
        if len(self._pairs) < 2:
            self._why = (ONE_PAIR,)
            return
        self._why = self._file.damage
        serves = {name: joined.serves for name, joined in self._pairs.items()}
        # LiDAR edges begin with the pose as built. A single look must not replace it: it is only one of many.
        serves |= {edge.name: ServedEdge(edge.T_a_b, KNOWN_BEFORE, NEVER_NS) for edge in measured}
        windows = {name: joined.window for name, joined in self._pairs.items() if joined.window is not None}
        fresh = self._file.restored(rig_estimator.initial_rig(self._graph, serves, windows))
        self._rig = fresh if self._rig is None else rig_estimator.grown(self._rig, fresh)

    def _notify_pairs(self, before: VehicleRig | None, stamp_ns: int) -> None:
        """Hands a new correction to its pairs, and wishes to the pairs of which a window is awaited now."""
        rig = self._rig
        self._window_requests |= window_requests(before, rig, stamp_ns + LAG_NS)
        if rig is None or rig.correction is None or (before is not None and before.correction is rig.correction):
            return
        correction, self._from_ns = rig.correction, stamp_ns + LAG_NS
        sensors = " and ".join(correction.sensors)
        text = f"{sensors} moved: all its pairs, {', '.join(correction.pairs)}, are put right by the windows of all."
        _log.info(
            "a displaced sensor is corrected", extra={"fields": {"sensors": sensors, "pairs": [*correction.pairs]}}
        )
        for name, joint_pose in correction.pairs.items():
            self._corrections.setdefault(name, deque(maxlen=MOST_CORRECTIONS)).append(
                PairCorrection(joint_pose, stamp_ns, self._from_ns, text)
            )

    # --- what is known ----------------------------------------------------------------------------------------------

    def _snapshot(self) -> RigSnapshot:
        stamp_ns = self._schedule.taken_ns
        known = stamp_ns if stamp_ns > NEVER_NS // 2 else None
        lidars = tuple(self._lidars[name] for name in sorted(self._lidars))
        losses = {**self._losses, **self._schedule.losses}
        return RigSnapshot(self._graph, self._rig, self._why, known, self._from_ns, lidars, losses)

    def _save_in_time(self, before: VehicleRig | None, stamp_ns: int) -> None:
        rig = self._rig
        if rig is None or rig is before:
            return
        same = before is not None and before.event is rig.event and before.serves is rig.serves
        if not same or stamp_ns - self._saved_ns > SAVE_NS or stamp_ns < self._saved_ns:
            self._saved_ns = stamp_ns
            self._save()

    def _save(self) -> None:
        if self._rig is not None:
            self._file.update(self._rig)
            self._disk_writer.write(self._file)
