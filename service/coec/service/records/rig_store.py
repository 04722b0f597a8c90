"""What is kept of a rig: the baseline of a pair's rig, as long as it fits, and, in the file `sensors.json`, where the
pairs of the vehicle were, which of its sensors had moved, and what was known before they did.

If a sensor is knocked while the service is down, the first looks after the start show it. The file may be of another
version of the software: an edge, or the move of a sensor, that cannot be read falls back alone.

The file's classes are the form of the file and no copy of others: they bound everything that is read.
"""

import contextlib
import threading
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from coec.calibration import state as lifecycle
from coec.calibration.baseline import Baseline, BaselineDrift, drift, learned_hash, mismatch
from coec.calibration.rig import attribution, rig_estimator
from coec.calibration.rig.attribution import RigState
from coec.calibration.rig.edge_observations import MOST_SIGMA, EdgeHistory, information_of
from coec.calibration.rig.graph import MOST_SENSORS
from coec.calibration.rig.joint_estimate import PreMoveKnowledge
from coec.calibration.tracker import Measurement
from coec.calibration.types import Estimate, Matrix4, Reason, Rig, Uncertainty
from coec.config import CalibrationConfig, PairConfig, StateConfig
from coec.errors import StateError
from coec.geometry import se3
from coec.io.rig_files import BASELINES, baseline_of_rig, load_baseline, save_baseline
from coec.io.storage import StateFile
from coec.schemas.message import Part
from coec.schemas.replies import Maybe6x6, Row4, Vector6

RIG_FILE = "sensors.json"

MOST_PAIRS = 128
"""Most pairs that a file may hold to be read: twice as many as a vehicle may have, and as many edges between its
LiDARs."""

MOST_TERMS = 32
"""Most terms of a covariance that a file may hold to be read: three times as many as there are."""

Rows = tuple[Row4, Row4, Row4, Row4]
Sigma = Annotated[float, Field(gt=0, lt=MOST_SIGMA)]
Stamp = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Name = Annotated[str, Field(max_length=256)]


class StoredEdge(Part):
    """A pair: its nominal calibration, and its pose before the looks that were kept, with standard deviations."""

    nominal: Rows
    T_camera_lidar: Rows
    sigma: tuple[Sigma | None, Sigma | None, Sigma | None, Sigma | None, Sigma | None, Sigma | None]


class StoredKnown(Part):
    """The pose of a pair by all its windows, exactly; its covariance is in parts, like that of a window."""

    T_camera_lidar: Rows
    noise: Maybe6x6
    systematic: dict[Name, Vector6] = Field(max_length=MOST_TERMS)
    stamp_ns: Stamp


class StoredEvent(Part):
    """A move that is not over, and what was known before it of the pairs of its sensors."""

    sensors: tuple[Name, ...] = Field(min_length=1, max_length=MOST_SENSORS)
    since_ns: Stamp
    stepped_ns: Stamp
    named: tuple[Name, ...] = Field(max_length=MOST_SENSORS)
    before: dict[Name, StoredKnown] = Field(default={}, max_length=MOST_PAIRS)


class StoredRig(Part):
    """The file: of every edge a `StoredEdge`, and a `StoredEvent` or null."""

    edges: dict[Name, Any] = Field(max_length=MOST_PAIRS)
    event: Any = None


class RigStore:
    """The file of one rig. `restored` and `update` belong to the thread of the engine, `flush` to the one that waits
    for the disk.

    Attributes:
        damage: what was wrong with the file at the start; empty if nothing was.
    """

    def __init__(self, folder: Path) -> None:
        self._file = StateFile(folder / RIG_FILE)
        self._lock = threading.Lock()
        self._body: dict[str, Any] | None = None
        loaded = self._file.load()
        self._on_disk = loaded.body
        damage = [*loaded.damage]
        self._edges: dict[str, StoredEdge] = {}
        self._event: StoredEvent | None = None
        refused = [] if loaded.body is None else self._read(loaded.body)
        if refused:
            self._file.reject()
            self._on_disk = None
            why = "not in the form of this version, or with a pose that is no rigid transform"
            damage.append(f"{RIG_FILE}: {', '.join(refused)} ({why})")
        text = (
            f"Something that was known of the rig cannot be used: {'; '.join(damage)}. The file is kept aside, what is "
            "missing is learnt anew, and everything else is kept."
        )
        self.damage = (Reason("rig_state_damaged", text),) if damage else ()

    def _read(self, body: dict[str, Any]) -> list[str]:
        """Reads the edges and the event, each by itself. Returns what could not be read."""
        try:
            stored = StoredRig.model_validate(body)
        except ValidationError:
            return ["everything"]
        for name, edge in stored.edges.items():
            with contextlib.suppress(ValueError):  # of which a ValidationError is one
                self._edges[name] = _sound_edge(StoredEdge.model_validate(edge))
        with contextlib.suppress(ValueError):
            self._event = None if stored.event is None else _sound_event(StoredEvent.model_validate(stored.event))
        unread = len(stored.edges) - len(self._edges)
        edges = [f"{unread} of {len(stored.edges)} edges"] if unread else []
        return edges if self._event is not None or stored.event is None else [*edges, "the move of a sensor"]

    def restored(self, rig: rig_estimator.VehicleRig) -> rig_estimator.VehicleRig:
        """Adds to a fresh rig, before any look, what was known before the restart."""
        histories = dict(rig.believed.histories)
        for name, edge in rig.graph.edge.items():
            stored = self._edges.get(name)
            # With another nominal calibration the mount is another one.
            if stored is not None and np.array_equal(_pose(stored.nominal), edge.T_a_b):
                sigma = np.array([np.nan if value is None else value for value in stored.sigma])
                histories[name] = EdgeHistory.at(_pose(stored.T_camera_lidar), sigma)
        event = self._event
        if event is None or not set(event.sensors) <= set(rig.graph.place):
            return replace(rig, believed=RigState(histories))
        named = frozenset(event.named) & frozenset(event.sensors)
        going_on = rig_estimator.MoveEvent(event.sensors, event.since_ns, event.stepped_ns)
        known = {name: _measurement(one) for name, one in event.before.items() if name in rig.graph.edge}
        believed = RigState(histories, stepped_ns=event.stepped_ns, named=named)
        return rig_estimator.resumed(replace(rig, believed=believed), going_on, PreMoveKnowledge(event.sensors, known))

    def update(self, rig: rig_estimator.VehicleRig) -> None:
        """Keeps what is known; the next `flush` writes it."""
        edges = {}
        for name, edge in rig.graph.edge.items():
            whole_history = rig.believed.histories[name]
            history = whole_history.counted() if rig.believed.calm else whole_history
            sigma = [float(value) if 0.0 < value < MOST_SIGMA else None for value in history.sigma.tolist()]
            edges[name] = {"nominal": edge.T_a_b.tolist(), "T_camera_lidar": history.pose.tolist(), "sigma": sigma}
        event = rig.event
        event_document = None
        if event is not None:
            event_document = {
                "sensors": list(event.sensors),
                "since_ns": event.since_ns,
                "stepped_ns": max(event.stepped_ns, attribution.BEFORE_ALL_NS),
                "named": sorted(rig.believed.named),
                "before": {} if rig.before is None else {name: _stored(of) for name, of in rig.before.edges.items()},
            }
        with self._lock:
            self._body = {"edges": edges, "event": event_document}

    def flush(self) -> None:
        """Writes what is kept to the disk, and what was written before if the file is gone.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        with self._lock:
            body, self._body = self._body, None
        if body is None and not self._file.exists():
            body = self._on_disk
        if body is None:
            return
        try:
            self._file.save(body)
        except StateError:
            with self._lock:
                self._body = body if self._body is None else self._body
            raise
        self._on_disk = body


def _sound_edge(edge: StoredEdge) -> StoredEdge:
    """The edge, with its poses checked: the checksum does not prove that this service wrote it.

    Raises:
        ValueError: a pose is no rigid transform.
    """
    if not (se3.is_rigid(_pose(edge.nominal)) and se3.is_rigid(_pose(edge.T_camera_lidar))):
        raise ValueError("a pose is no rigid transform")
    return edge


def _sound_event(event: StoredEvent) -> StoredEvent:
    """The event, with its poses and covariances checked likewise.

    Raises:
        ValueError: a pose is no rigid transform, or a matrix is no covariance.
    """
    for known in event.before.values():
        measured = _measurement(known)
        if not se3.is_rigid(measured.T_camera_lidar):
            raise ValueError("a pose is no rigid transform")
        information_of(measured.uncertainty.noise)
        if any(abs(value) >= MOST_SIGMA for shift in known.systematic.values() for value in shift):
            raise ValueError("a shift exceeds the largest that is estimated")
    return event


def _stored(known: Measurement) -> dict[str, Any]:
    noise = [[value if isfinite(value) else None for value in row] for row in known.uncertainty.noise.tolist()]
    systematic = {name: shift.tolist() for name, shift in known.uncertainty.systematic.items()}
    return {
        "T_camera_lidar": known.T_camera_lidar.tolist(),
        "noise": noise,
        "systematic": systematic,
        "stamp_ns": known.stamp_ns,
    }


def _measurement(stored: StoredKnown) -> Measurement:
    """The measurement on the disk. How many looks its windows were worth is not kept, because it does not matter for a
    mount that has moved since."""
    noise = np.array([[np.nan if value is None else value for value in row] for row in stored.noise])
    systematic = {name: np.array(shift) for name, shift in stored.systematic.items()}
    return Measurement(_pose(stored.T_camera_lidar), Uncertainty(noise, systematic, np.nan), stored.stamp_ns)


def _pose(rows: Rows) -> Matrix4:
    return np.array(rows, dtype=np.float64)


class RigBaseline:
    """Belongs to the thread of the engine; `flush` is for the disk writer.

    Attributes:
        problem: why an existing baseline is not used; else None.
    """

    def __init__(self, pair: PairConfig, rig: Rig, state: StateConfig) -> None:
        self._pair = pair
        self._rig = rig
        self._state = state
        self._baseline: Baseline | None = None
        self._own: Baseline | None = None
        self.problem: Reason | None = None
        self.load()

    def load(self) -> None:
        """Reads the baseline from the disk, where the worker writes it."""
        self._baseline, self.problem = None, None
        try:
            self._own = load_baseline(self._state.directory / BASELINES, self._rig.pair)
            baseline = baseline_of_rig(self._rig, self._state)
        except StateError as error:
            self.problem = Reason("baseline_damaged", f"The baseline of the rig cannot be used: {error}")
            return
        if baseline is None:
            return
        wrong = mismatch(baseline, self._rig, baseline.depth_identity, learned_hash(self._pair.calibration))
        if wrong is None:
            self._baseline = baseline
        else:
            self.problem = _mismatched(wrong)

    def flush(self) -> None:
        """Writes the rig's own baseline again if somebody has removed it.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        path, own = self._state.directory / BASELINES, self._own
        try:
            there = load_baseline(path, self._rig.pair)
        except StateError:
            return  # a damaged file stays, so that people can look into it
        if own is not None and there is None:
            save_baseline(path, own)

    def reconfigure(self, pair: PairConfig) -> None:
        """Goes on with other settings, which the baseline may not fit."""
        self._pair = pair
        self.load()

    def refuse(self, why: str) -> bool:
        """Stops using the baseline because it does not fit after all. Returns whether it was in use."""
        if self._baseline is None:
            return False
        self._baseline, self.problem = None, _mismatched(why)
        return True

    def fits_network(self, depth_identity: str) -> bool:
        """Whether the baseline was made with the network that the worker has opened; True without a baseline."""
        return self._baseline is None or self._baseline.depth_identity == depth_identity

    @property
    def calibration(self) -> CalibrationConfig:
        """The configuration for windows: with the limits that were learned on this rig, if there is a baseline."""
        configured = self._pair.calibration
        if self._baseline is None:
            return configured
        return configured.model_copy(update={"verdict": self._baseline.verdict(configured.verdict)})

    def unbiased(self, estimate: Estimate) -> Estimate:
        """The estimate with the estimator's bias on this rig taken out."""
        if self._baseline is None:
            return estimate
        return lifecycle.moved(estimate, self._baseline.unbiased(estimate.optimum.T_camera_lidar), self._rig)

    def moved(self, estimate: Estimate, pose: Matrix4) -> Estimate:
        """The estimate with another pose (4, 4), from which the estimator's bias has been taken out."""
        return lifecycle.moved(estimate, pose, self._rig)

    def drift(self, T_camera_lidar: Matrix4, sigma: NDArray[np.float64] | None) -> BaselineDrift | None:
        """Drift from the commissioned calibration to a pose (4, 4) without bias, whose standard deviations are `sigma`
        (6,) (None: unknown). None before commissioning."""
        if self._baseline is None:
            return None
        known = np.full(6, np.nan) if sigma is None else sigma
        return drift(se3.perturb(T_camera_lidar, self._baseline.bias), known, self._baseline)


def _mismatched(text: str) -> Reason:
    return Reason("baseline_mismatch", f"The baseline of the rig is not used: {text}")
