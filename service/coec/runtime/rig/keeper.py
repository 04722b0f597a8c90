"""The thread that puts together what the pairs of a vehicle report. Only this thread changes what is known of the rig.

Pairs hand in their reports from their own threads; here they are taken in one order (`order`). What the rig tells a
pair counts `LAG_NS` later in the choice of the pair's frames, and the frames wait for it. So it changes the same things
at the same sensor time, however long it takes to compute, just like the worker's answers to a pair.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from coec.adapters.files.scribe import DiskWriter
from coec.adapters.system.threads import ServiceThread
from coec.calibration.lidar_to_lidar.types import KNOWN_BEFORE
from coec.calibration.lifecycle import PairState
from coec.calibration.rig import vehicle
from coec.calibration.rig.evidence import EdgeObservation
from coec.calibration.rig.types import RigGraph
from coec.calibration.rig.vehicle import EdgeWindow, ServedEdge, VehicleRig
from coec.calibration.tracker import Measurement, prior_sigma
from coec.calibration.types import Matrix4, Reason
from coec.config import LinkConfig, PairConfig
from coec.runtime.ingest.sensor_clock import NS_PER_S
from coec.runtime.recording.window_store import start_ns_of
from coec.runtime.rig import order
from coec.runtime.rig.graph import graph_of
from coec.runtime.rig.lidar_side import LidarPairReport, LidarPairStatus
from coec.runtime.rig.pair_side import PairCorrection, PairReport, RigMember, served_by
from coec.runtime.rig.rig_file import RigStore
from coec.runtime.rig.wishes import WindowRequest, window_requests

_log = logging.getLogger(__name__)

LAG_NS = 15 * NS_PER_S
"""Sensor time from a report of a pair until what the rig tells the pairs counts. If the windows of one pair take the
worker so long that the pair is this far behind another, it holds the other up."""

QUIET_TICKS = 4
"""Ticks without a frame of any pair after which, once every question is answered, all reports are taken: nothing
earlier can come. Ticks are counted instead of seconds, because a process that slept has samples to take first."""

TICK_S = 1.0

MOST_CORRECTIONS = 4
"""How many corrections of one pair may wait for its frames. If a pair has no frames, the newest ones stay."""

SAVE_NS = 60 * NS_PER_S
"""Sensor time between two savings while nothing happens. If the process is killed, a minute of looks is lost."""

ONE_PAIR = Reason("one_pair", "One pair cannot tell its camera from its LiDAR: its `health` says whether either moved.")


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


class RigEstimatorThread:
    """The rig of one vehicle. `put`, `at`, `step_back`, `corrections`, `window_wanted`, `join` and `join_lidars` are
    for any thread; everything else belongs to `thread`."""

    def __init__(self, folder: Path, links: Sequence[LinkConfig], disk_writer: DiskWriter) -> None:
        """Call `listen` before the first report."""
        self.thread = ServiceThread("rig", self._run)
        self._links = tuple(links)
        self._disk_writer = disk_writer
        self._file = RigStore(folder)
        disk_writer.register(self._file)
        self._condition = threading.Condition()
        self._schedule: order.ReportSchedule[
            PairReport | LidarPairReport | LidarPairStatus | _Joined | _SteppedBack
        ] = order.ReportSchedule()
        self._corrections: dict[str, deque[PairCorrection]] = {}
        self._window_requests: dict[str, WindowRequest] = {}
        self._pairs: dict[str, _Joined] = {}
        self._lidars: dict[str, LidarPairStatus] = {}
        self._have_all_answers: list[Callable[[], bool]] = []
        self._count = 0
        self._quiet_ticks = 0
        self._rig: VehicleRig | None = None
        self._graph: RigGraph | None = None
        self._why: tuple[Reason, ...] = ()
        self._from_ns: int | None = None
        self._losses: Counter[str] = Counter({"state_damaged": len(self._file.damage)} if self._file.damage else {})
        self._saved_ns = order.NEVER_NS
        self._on_update: Callable[[RigSnapshot], None] = lambda _: None
        self._wake: Callable[[], None] = lambda: None

    def connect(self, on_update: Callable[[RigSnapshot], None], wake: Callable[[], None]) -> None:
        """Sets two callbacks. `tell` is called with what is known: now, and whenever it has changed. `wake` is called
        when frames that wait for the rig may be looked at."""
        self._on_update, self._wake = on_update, wake
        self._publish()

    # --- on any thread ----------------------------------------------------------------------------------------------

    def join(
        self, pair: PairConfig, nominal: Matrix4, state: PairState, has_all_answers: Callable[[], bool]
    ) -> RigMember:
        """Adds a pair to the rig: with its nominal calibration (4, 4) and its state at the start. `has_all_answers`
        says whether all its questions are answered."""
        accepted = state.accepted
        window = (
            None
            if accepted is None
            else EdgeWindow(Measurement.from_estimate(accepted), start_ns_of(accepted.window_id))
        )
        serves = served_by(state, prior_sigma(pair.tracker))
        joined = _Joined(pair, nominal, serves, window)
        with self._condition:
            self._count += 1
            self._have_all_answers.append(has_all_answers)
            self._schedule.put(pair.name, None, joined)
            self._condition.notify_all()
        return RigMember(pair, self)

    def join_lidars(self, known: LidarPairStatus, has_all_answers: Callable[[], bool]) -> None:
        """Adds two LiDARs of pairs that have joined, whether they are looked at or not. The name of their edge stands
        for them. The edge belongs to the rig once a look has measured it."""
        with self._condition:
            self._have_all_answers.append(has_all_answers)
            self._schedule.put(known.edge.name, None, known)
            self._condition.notify_all()

    def put(self, pair: str, due_ns: int | None, report: PairReport | LidarPairReport) -> None:
        """See `pair_side.Keeps`."""
        with self._condition:
            if self._count < 2:
                if isinstance(report, EdgeObservation):
                    return
                due_ns = None  # there is no other pair whose report it could overtake
            self._schedule.put(pair, due_ns, report)
            if self._schedule.is_ready:
                self._condition.notify_all()

    def report_time(self, pair: str, stamp_ns: int, *, waits: bool) -> bool:
        """See `pair_side.Keeps`."""
        with self._condition:
            if self._count < 2:
                return False
            self._quiet_ticks = 0
            self._schedule.report_time(pair, stamp_ns, waits=waits)
            if self._schedule.is_ready:
                self._condition.notify_all()
            return self._schedule.taken_ns < stamp_ns - LAG_NS

    def step_back(self, pair: str, stamp_ns: int) -> None:
        """See `pair_side.Keeps`."""
        del pair
        with self._condition:
            if self._count < 2:
                return
            self._schedule.step_back(stamp_ns, _SteppedBack())
            for waiting in self._corrections.values():
                waiting.clear()
            self._window_requests.clear()
            self._condition.notify_all()

    def corrections(self, pair: str, stamp_ns: int) -> list[PairCorrection]:
        """See `pair_side.Keeps`."""
        with self._condition:
            waiting = self._corrections.get(pair)
            due = []
            while waiting and waiting[0].from_ns <= stamp_ns:
                due.append(waiting.popleft())
            return due

    def pop_window_request(self, pair: str, stamp_ns: int) -> int | None:
        """See `pair_side.Keeps`."""
        with self._condition:
            request = self._window_requests.get(pair)
            if request is None or request.from_ns > stamp_ns:
                return None
            del self._window_requests[pair]
            return request.since_ns

    def request_stop(self) -> None:
        """Has the thread take what was reported, and end."""
        self.thread.request_stop()
        with self._condition:
            self._condition.notify_all()

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.work(TICK_S)
        self.finish()

    def finish(self) -> None:
        """Takes all reports in their order, and saves what is known; for the end of the service."""
        while self._take_one(silent=True):
            pass
        self._save()

    def work(self, timeout_s: float) -> bool:
        """Takes the next report, waiting for it up to `timeout_s`; returns whether one came."""
        with self._condition:
            if not self._schedule.is_ready and timeout_s > 0.0 and not self._condition.wait(timeout_s):
                self._quiet_ticks += 1
            quiet = self._quiet_ticks >= QUIET_TICKS
            have_all_answers = list(self._have_all_answers)
        return self._take_one(silent=quiet and all(has() for has in have_all_answers))

    def _take_one(self, *, silent: bool) -> bool:
        with self._condition:
            report = self._schedule.take(all_are_silent=silent)
        if report is None:
            return False
        before = self._rig
        try:
            self._after(report.pair, report.due_ns, report.what)
        except ValueError as error:  # unusable numbers, from an estimate that went wrong
            self._losses["refused"] += 1
            _log.warning(f"what {report.pair} reported is left out of the rig: {error}")
        with self._condition:
            self._notify_pairs(before, report.due_ns)
            self._schedule.finish(report)
        self._wake()
        self._save_in_time(before, report.due_ns)
        self._publish()
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
            self._rig = vehicle.forgotten(self._rig)
        elif isinstance(what, EdgeObservation):
            self._rig = vehicle.after_edge_observation(self._rig, what)
        elif isinstance(what, EdgeWindow):
            self._rig = vehicle.after_window(self._rig, pair, what, due_ns)
        else:
            self._rig = vehicle.after_served(self._rig, pair, what, due_ns)

    def _after_lidars(self, name: str, report: LidarPairReport) -> None:
        self._lidars[name] = self._lidars[name].after(report)
        if report.registration is None or self._rig is None:
            return
        if name not in self._rig.graph.edge:
            self._grow()
        if self._rig is not None and name in self._rig.graph.edge:
            self._rig = vehicle.after_lidars(self._rig, report.registration.observation, report.registration.window)

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
            self._rig, self._why = None, (Reason("no_rig", f"The pairs are not put together: {error}."),)
            return
        if len(self._pairs) < 2:
            self._why = (ONE_PAIR,)
            return
        self._why = self._file.damage
        serves = {name: joined.serves for name, joined in self._pairs.items()}
        # LiDAR edges begin with the pose as built. A single look must not replace it: it is only one of many.
        serves |= {edge.name: ServedEdge(edge.T_a_b, KNOWN_BEFORE, order.NEVER_NS) for edge in measured}
        windows = {name: joined.window for name, joined in self._pairs.items() if joined.window is not None}
        fresh = self._file.restored(vehicle.initial_rig(self._graph, serves, windows))
        self._rig = fresh if self._rig is None else vehicle.grown(self._rig, fresh)

    def _notify_pairs(self, before: VehicleRig | None, stamp_ns: int) -> None:
        """Hands a new correction to its pairs, and wishes to the pairs of which a window is awaited now. Called with
        the lock."""
        rig = self._rig
        self._window_requests |= window_requests(before, rig, stamp_ns + LAG_NS)
        if rig is None or rig.correction is None or (before is not None and before.correction is rig.correction):
            return
        correction, self._from_ns = rig.correction, stamp_ns + LAG_NS
        sensors = " and ".join(correction.sensors)
        text = f"{sensors} moved: all its pairs, {', '.join(correction.pairs)}, are put right by the windows of all."
        _log.info(
            "a move of a sensor is put right", extra={"fields": {"sensors": sensors, "pairs": [*correction.pairs]}}
        )
        for name, joint_pose in correction.pairs.items():
            self._corrections.setdefault(name, deque(maxlen=MOST_CORRECTIONS)).append(
                PairCorrection(joint_pose, stamp_ns, self._from_ns, text)
            )

    # --- telling ----------------------------------------------------------------------------------------------------

    def _publish(self) -> None:
        with self._condition:
            stamp_ns = self._schedule.taken_ns
            losses = {**self._losses, **self._schedule.losses}
        known = stamp_ns if stamp_ns > order.NEVER_NS // 2 else None
        lidars = tuple(self._lidars[name] for name in sorted(self._lidars))
        self._on_update(RigSnapshot(self._graph, self._rig, self._why, known, self._from_ns, lidars, losses))

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
