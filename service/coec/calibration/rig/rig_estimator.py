"""The rig of one vehicle, step by step: combines checks, accepted windows and what the pairs serve; and the alarm that
the rig raises about a pair. A move of a sensor is one event. It begins when the sensor is named (`attribution`). It
is corrected when every live pair of the sensor has an accepted window from after the move: the joint estimate, with
what was known before the move, then corrects all pairs of the sensor at once, with one move for all of them. The
event is over when all these pairs serve the correction or a pose that they estimated since; their observations are
counted from that pose on.

A move of a sensor is one event. It begins when the sensor is named (`attribution`). It is put right when every live
pair of the sensor has an accepted window from after the move: the joint estimate (`joint`), with what was known before
the move (`before`), then corrects all pairs of the sensor at once, with one move for all of them. The event is over
when all these pairs serve the correction or a pose that they found since; their looks are counted from that pose on.

Windows of a rig that just moved do not fit those of before. While that is in question the objection is a suspicion;
once a sensor is named it is a move; only if neither holds do the pairs contradict each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig import attribution
from coec.calibration.rig.attribution import STEPPED2, RigState, SensorHealth, SensorState
from coec.calibration.rig.edge_observations import MAX_OBSERVATIONS, EdgeObservation, observation_of_window
from coec.calibration.rig.graph import RigGraph
from coec.calibration.rig.joint_estimate import JointEstimate, PreMoveKnowledge, estimate_jointly
from coec.calibration.rig.moved_sensors import Moved, movers
from coec.calibration.tracker import Measurement
from coec.calibration.types import NS_PER_S, Matrix4
from coec.geometry import linalg, se3

ALIVE_NS = 60 * NS_PER_S
"""An event does not wait for a pair that had no look for this time: 12 periods of the monitor."""

OVER_NS = 900 * NS_PER_S
"""After this time an event is over, whatever its pairs serve, if no sensor is named any more: five slices."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeWindow:
    """An accepted window of a pair: its measurement and the stamp of its first pair of frames."""

    measurement: Measurement
    start_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class ServedEdge:
    """The pose (4, 4) that a pair serves, known to `sigma` (6,), from frames since `start_ns`. `start_ns` is None if
    the pose comes from no frames but from how the vehicle was built or from a person. `known` is what all windows of
    the pair together say of the mount, if there are any."""

    T_a_b: Matrix4
    sigma: NDArray[np.float64]
    start_ns: int | None
    known: Measurement | None = None


@dataclass(frozen=True, slots=True, eq=False)
class JointPose:
    """What the joint estimate says of a pair: a pose (4, 4) and the covariance (6, 6) of its perturbation.

    Axes that the pair's own window does not determine are as in that window, and NaN in the covariance. A pair without
    a window from after the move has no such axes: the other pairs and what was known of it before determine its pose.
    """

    T_a_b: Matrix4
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RigCorrection:
    """One correction for all pairs of the sensors that moved, decided at a stamp."""

    stamp_ns: int
    sensors: tuple[str, ...]
    pairs: Mapping[str, JointPose]


@dataclass(frozen=True, slots=True)
class MoveEvent:
    """Sensors that have been named since the stamp `since_ns`; their move lies before the stamp `stepped_ns`.
    `corrected`: whether the correction of their pairs has been decided."""

    sensors: tuple[str, ...]
    since_ns: int
    stepped_ns: int
    corrected: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MoveRecord:
    """An event, kept for later queries: by how much each of its sensors moved, by name, as far as that was known when
    they were named; and the stamp at which the event was over, None while it goes on."""

    event: MoveEvent
    moved: Mapping[str, Moved]
    over_ns: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class VehicleRig:
    """All that is known of the rig.

    Attributes:
        believed: who moved.
        windows: the newest window of each edge, if it is of the rig as it is now.
        serves: what each pair serves.
        known: what all windows of each pair said together, the latest two versions, the older first: when a move is
            noticed, the latest may be from after it.
        before: what was known before the current event and is still true after it.
        event: the current event; None while all is calm.
        move: the latest event, over or not; None before the first.
        joint: the rig by these windows; None while no window determines anything.
        sensors: what is believed of each sensor, in the order of names.
        since_ns: since when each sensor is in its state, by name.
        correction: the latest correction.
        observations: number of looks counted, by edge.
        registered: the latest look at two LiDARs, by edge, whether or not another one agreed with it.
    """

    graph: RigGraph
    believed: RigState
    serves: Mapping[str, ServedEdge]
    windows: Mapping[str, EdgeWindow] = field(default_factory=dict)
    known: Mapping[str, tuple[Measurement, ...]] = field(default_factory=dict)
    before: PreMoveKnowledge | None = None
    event: MoveEvent | None = None
    move: MoveRecord | None = None
    joint: JointEstimate | None = None
    sensors: tuple[SensorState, ...] = ()
    since_ns: Mapping[str, int] = field(default_factory=dict)
    correction: RigCorrection | None = None
    observations: Mapping[str, int] = field(default_factory=dict)
    registered: Mapping[str, EdgeWindow] = field(default_factory=dict)


def initial_rig(graph: RigGraph, serves: Mapping[str, ServedEdge], windows: Mapping[str, EdgeWindow]) -> VehicleRig:
    """The rig before any look: every edge is where its pair serves it, with that uncertainty. `windows` are the windows
    that the served poses rest on."""
    believed = attribution.initial(graph)
    for name in graph.edge:
        believed = attribution.served(believed, name, serves[name].T_a_b, serves[name].sigma)
    sensors = attribution.sensors(believed, graph)
    known = {name: (of.known,) for name, of in serves.items() if of.known is not None}
    return _combined(VehicleRig(graph, believed, dict(serves), dict(windows), known, sensors=sensors))


def resumed(rig: VehicleRig, event: MoveEvent, before: PreMoveKnowledge) -> VehicleRig:
    """The rig with an event that began before a restart, and what was known before that event. Windows of its edges
    from before the move are dropped."""
    sensors = attribution.sensors(rig.believed, rig.graph)
    since_ns = {sensor.name: event.since_ns for sensor in sensors if sensor.name in rig.believed.named}
    rig = replace(rig, event=event, before=before, move=MoveRecord(event, {}), sensors=sensors, since_ns=since_ns)
    return _without_stale(rig)


def grown(rig: VehicleRig, fresh: VehicleRig) -> VehicleRig:
    """The rig with the pairs of another rig, at which there was no look yet, added to its own."""
    histories = {**fresh.believed.histories, **rig.believed.histories}
    believed = replace(rig.believed, histories=histories, posterior=None)
    rig = replace(
        rig,
        graph=fresh.graph,
        believed=believed,
        serves={**fresh.serves, **rig.serves},
        windows={**fresh.windows, **rig.windows},
        known={**fresh.known, **rig.known},
        before=_before_of_both(rig.before, fresh.before),
        sensors=attribution.sensors(believed, fresh.graph),
    )
    return _combined(rig)


def _before_of_both(before: PreMoveKnowledge | None, fresh: PreMoveKnowledge | None) -> PreMoveKnowledge | None:
    """What was known before one event, for the pairs of a rig together with those that join it."""
    if before is None or fresh is None or before.sensors != fresh.sensors:
        return before
    return replace(before, edges={**fresh.edges, **before.edges})


def after_edge_observation(rig: VehicleRig, observation: EdgeObservation) -> VehicleRig:
    """The rig after a check, or any other look, says where an edge is.

    Raises:
        ValueError: the look is of no edge of the rig.
    """
    believed = attribution.after_edge_observation(rig.believed, rig.graph, observation)
    attributed = believed.attributed_ns != rig.believed.attributed_ns
    observations = {**rig.observations, observation.edge: rig.observations.get(observation.edge, 0) + 1}
    rig = replace(rig, believed=believed, observations=observations)
    if not attributed:
        return rig
    return _followed(_noted(rig, observation.stamp_ns), observation.stamp_ns)


def after_window(rig: VehicleRig, edge: str, window: EdgeWindow, stamp_ns: int) -> VehicleRig:
    """The rig after a window of an edge was accepted, which was known at `stamp_ns`. The window says where the edge is
    and who moved. A window that began before a move of its sensors is ignored, because it shows neither mount.

    Raises:
        ValueError: it is of no edge of the rig, or its pose or covariance is invalid.
    """
    if _from_before_a_move(rig, edge, window):
        return rig
    rig = _combined(replace(rig, windows={**rig.windows, edge: window}))
    observation = observation_of_window(edge, window.measurement)
    if observation is not None:
        # All of its frames lie after a step only if the first one does.
        observation = replace(observation, stamp_ns=window.start_ns)
        rig = _noted(replace(rig, believed=attribution.after_window(rig.believed, rig.graph, observation)), stamp_ns)
    return _followed(rig, stamp_ns)


def after_lidars(rig: VehicleRig, observation: EdgeObservation, window: EdgeWindow) -> VehicleRig:
    """The rig after two LiDARs were registered to each other, which is one look.

    Attribution uses the look at once. The joint estimate uses it once the next look agrees with it: a single look may
    be bad, or the first after a move, which fits no window from before. No pair serves the pose between two LiDARs, so
    the pose found counts as served.

    Raises:
        ValueError: the look is of no edge of the rig.
    """
    measured = window.measurement
    pose_served = ServedEdge(measured.T_camera_lidar, measured.uncertainty.sigma, window.start_ns)
    rig = after_edge_observation(replace(rig, serves={**rig.serves, observation.edge: pose_served}), observation)
    before = rig.registered.get(observation.edge)
    rig = replace(rig, registered={**rig.registered, observation.edge: window})
    if before is None or not _agree(before.measurement, measured) or _from_before_a_move(rig, observation.edge, window):
        return rig
    return _followed(_combined(replace(rig, windows={**rig.windows, observation.edge: window})), observation.stamp_ns)


def _agree(one: Measurement, other: Measurement) -> bool:
    """Whether two looks at an edge differ by no more than chance."""
    difference = se3.difference(one.T_camera_lidar, other.T_camera_lidar)
    covariance = one.uncertainty.covariance + other.uncertainty.covariance
    return float(linalg.squared(linalg.inverse(covariance), difference)) < STEPPED2


def _from_before_a_move(rig: VehicleRig, edge: str, window: EdgeWindow) -> bool:
    """Whether a window began before a sensor of its edge moved."""
    event = rig.event
    return event is not None and window.start_ns < event.stepped_ns and edge in pairs_of(rig.graph, event.sensors)


def after_served(rig: VehicleRig, edge: str, serves: ServedEdge, stamp_ns: int) -> VehicleRig:
    """The rig after a pair serves another pose. The first pose that rests on frames says where the edge is, if all is
    calm; later ones do not, because they correct what looks show as well."""
    before = rig.serves[edge]
    rig = _serving(rig, edge, serves)
    if rig.event is None and before.start_ns is None and serves.start_ns is not None and rig.believed.calm:
        rig = replace(rig, believed=attribution.served(rig.believed, edge, serves.T_a_b, serves.sigma))
    return _followed(rig, stamp_ns)


def forgotten(rig: VehicleRig) -> VehicleRig:
    """The rig after sensor time stepped back: looks of the old time are dropped, as are windows and the event. What was
    known before those looks stays."""
    histories = {name: replace(history, observations=()) for name, history in rig.believed.histories.items()}
    believed = RigState(histories)
    rig = replace(rig, believed=believed, windows={}, known={}, before=None, joint=None, event=None, move=None)
    rig = replace(rig, since_ns={}, registered={})
    return replace(rig, sensors=attribution.sensors(believed, rig.graph))


def pairs_of(graph: RigGraph, sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Edges that a move of these sensors displaces: those that end at any of them, except edges between two sensors of
    a bar that moved as one."""
    moved = set(sensors)
    bars = [set(mover.sensors) for mover in movers(graph) if len(mover.sensors) > 1]
    return tuple(
        edge.name
        for edge in graph.edges
        if {edge.a, edge.b} & moved and not any({edge.a, edge.b} <= bar <= moved for bar in bars)
    )


def renewed(rig: VehicleRig, edge: str, since_ns: int) -> bool:
    """Whether a pair serves a pose from frames since `since_ns`."""
    start_ns = rig.serves[edge].start_ns
    return start_ns is not None and start_ns >= since_ns


def _serving(rig: VehicleRig, edge: str, serves: ServedEdge) -> VehicleRig:
    """The rig with a new served pose for an edge, and with what that says is known of the edge."""
    rig = replace(rig, serves={**rig.serves, edge: serves})
    if serves.known is None:
        return rig
    return replace(rig, known={**rig.known, edge: (*rig.known.get(edge, ()), serves.known)[-2:]})


def _noted(rig: VehicleRig, stamp_ns: int) -> VehicleRig:
    """The rig with what is now believed of the sensors, and since when."""
    sensors = attribution.sensors(rig.believed, rig.graph)
    before = {sensor.name: sensor.health for sensor in rig.sensors}
    since_ns = {
        sensor.name: rig.since_ns[sensor.name]
        if sensor.name in rig.since_ns and before.get(sensor.name) is sensor.health
        else stamp_ns
        for sensor in sensors
        if sensor.health is not SensorHealth.UNKNOWN
    }
    return replace(rig, sensors=sensors, since_ns=since_ns)


def _followed(rig: VehicleRig, stamp_ns: int) -> VehicleRig:
    """The rig with its event carried on: it may begin, be put right, or be over."""
    rig = _started_or_extended(rig, stamp_ns)
    event = rig.event
    if event is None:
        return _settled_unnamed(rig, stamp_ns)
    pairs = pairs_of(rig.graph, event.sensors)
    served = _served(rig, pairs)
    alive = [name for name in served if _last_ns(rig, name) > stamp_ns - ALIVE_NS]
    fresh = [name for name in pairs if name in rig.windows]
    if not event.corrected:
        if _served(rig, fresh) and set(alive) <= set(fresh):
            return _followed(_corrected(rig, event, fresh, stamp_ns), stamp_ns)
    elif alive and all(renewed(rig, name, event.stepped_ns) for name in alive):
        return _over(rig, pairs, stamp_ns)
    if stamp_ns - event.since_ns > OVER_NS and not rig.believed.named:
        return _over(rig, pairs, stamp_ns)
    return rig


def _settled_unnamed(rig: VehicleRig, stamp_ns: int) -> VehicleRig:
    """The rig when something moved but no sensor is named. That is over when every pair that stepped serves a pose that
    it found since. If only edges between LiDARs stepped, it is over when all their kept looks are from after the
    step."""
    if rig.believed.calm:
        return rig
    pairs = attribution.stepped(rig.believed)
    served, since_ns = _served(rig, pairs), rig.believed.stepped_ns
    if served:
        is_over = all(renewed(rig, name, since_ns) for name in served)
    else:
        of_pairs = [rig.believed.histories[name].observations for name in pairs]
        is_over = all(
            len(observations) >= MAX_OBSERVATIONS and observations[0].stamp_ns >= since_ns for observations in of_pairs
        )
    return _over(rig, pairs, stamp_ns) if pairs and is_over else rig


def _served(rig: VehicleRig, edges: Sequence[str]) -> list[str]:
    """Those of these edges that a pair serves. Only their serving a new pose puts a move right."""
    return [name for name in edges if name not in rig.graph.of_lidars]


def _corrected(rig: VehicleRig, event: MoveEvent, fresh: list[str], stamp_ns: int) -> VehicleRig:
    """The rig once all live pairs of an event have a window from after it. There is no correction if only one pair was
    measured, because that pair already knows, or if the pairs do not fit each other."""
    rig = replace(rig, event=replace(event, corrected=True))
    joint = rig.joint
    if joint is None or not (joint.consistent or joint.left_out is not None):
        return rig
    measured = [name for name in fresh if name in joint.measured]
    joint_poses = {name: _joint_pose(joint, name, rig.windows[name].measurement) for name in _served(rig, measured)}
    if len(measured) < 2 or not joint_poses:
        return rig
    if rig.before is not None:
        # Pairs without a window from after the move: the windows of other pairs place the sensor that moved, and what
        # was known before places its other sensor.
        joint_poses |= {
            name: JointPose(joint.T_a_b[name], joint.between(name, name))
            for name in _served(rig, [*rig.before.edges])
            if name not in fresh
        }
    return replace(rig, correction=RigCorrection(stamp_ns, event.sensors, joint_poses))


def _started_or_extended(rig: VehicleRig, stamp_ns: int) -> VehicleRig:
    """The rig with a new or larger event if a sensor is newly named. Windows of its edges from before the move are
    dropped."""
    named, event = rig.believed.named, rig.event
    if not named or (event is not None and named <= set(event.sensors)):
        return rig
    sensors = tuple(sorted(named if event is None else named | set(event.sensors)))
    pairs = pairs_of(rig.graph, sensors)
    after = [
        observation.stamp_ns
        for name in pairs
        for observation in rig.believed.histories[name].observations
        if observation.stamp_ns >= rig.believed.stepped_ns
    ]
    stepped_ns = min(after, default=stamp_ns) if event is None else event.stepped_ns
    since_ns = stamp_ns if event is None else event.since_ns
    event = MoveEvent(sensors, since_ns, stepped_ns)
    moved = {sensor.name: sensor.moved for sensor in rig.sensors if sensor.name in sensors and sensor.moved is not None}
    return _without_stale(replace(rig, before=_before(rig, event), event=event, move=MoveRecord(event, moved)))


def _before(rig: VehicleRig, event: MoveEvent) -> PreMoveKnowledge:
    """What was known before an event: for each edge the latest knowledge up to the last look that saw no move."""
    touched = pairs_of(rig.graph, event.sensors)
    right_ns = max(
        (observation.stamp_ns for name in touched for observation in rig.believed.histories[name].observations
         if observation.stamp_ns < min(rig.believed.stepped_ns, event.stepped_ns)),
        default=event.stepped_ns,
    )  # fmt: skip
    known = {name: rig.known[name] for name in touched if name in rig.known}
    return PreMoveKnowledge.of(event.sensors, known, right_ns, event.since_ns)


def _joint_pose(joint: JointEstimate, edge: str, own: Measurement) -> JointPose:
    axes = np.isin(np.arange(6), own.determined_axes())
    difference = np.where(axes, se3.difference(joint.T_a_b[edge], own.T_camera_lidar), 0.0)
    covariance = np.where(axes[:, None] & axes, joint.between(edge, edge), np.nan)
    return JointPose(se3.perturb(own.T_camera_lidar, difference), covariance)


def _over(rig: VehicleRig, pairs: tuple[str, ...], stamp_ns: int) -> VehicleRig:
    """The rig after an event: from now on the edges of its pairs are where the correction put them, or else where they
    are served."""
    believed, event, last = rig.believed, rig.event, rig.correction
    corrections = last.pairs if last is not None and event is not None and last.stamp_ns >= event.since_ns else {}
    for name in pairs:
        T_a_b, sigma = rig.serves[name].T_a_b, rig.serves[name].sigma
        if name in corrections:
            T_a_b, sigma = corrections[name].T_a_b, np.sqrt(corrections[name].covariance.diagonal())
        believed = attribution.served(believed, name, T_a_b, sigma)
    since_ns = rig.believed.stepped_ns if event is None else event.stepped_ns
    known = {
        name: tuple(one for one in of if name not in pairs or one.stamp_ns >= since_ns)
        for name, of in rig.known.items()
    }
    move = rig.move if event is None or rig.move is None else replace(rig.move, over_ns=stamp_ns)
    believed = attribution.settled(believed)
    return _noted(replace(rig, believed=believed, known=known, before=None, event=None, move=move), stamp_ns)


def _without_stale(rig: VehicleRig) -> VehicleRig:
    """The rig without those windows of the event's edges that began before the move."""
    event = rig.event
    if event is None:
        return rig
    pairs = pairs_of(rig.graph, event.sensors)
    current = {name: one for name, one in rig.windows.items() if name not in pairs or one.start_ns >= event.stepped_ns}
    return _combined(replace(rig, windows=current))


def _combined(rig: VehicleRig) -> VehicleRig:
    """The rig with the joint estimate from its present windows and from what was known before the current event."""
    measurements = {
        name: window.measurement for name, window in rig.windows.items() if window.measurement.determined_axes()
    }
    return replace(rig, joint=estimate_jointly(rig.graph, measurements, rig.before) if measurements else None)


def _last_ns(rig: VehicleRig, edge: str) -> int:
    observations = rig.believed.histories[edge].observations
    return observations[-1].stamp_ns if observations else attribution.BEFORE_ALL_NS


class RigAlarm(StrEnum):
    """`moved`: a sensor of the pair was named, and the pair still serves a pose of before the move. `suspected`: the
    windows of the rig do not fit each other, and a sensor of the pair may have moved. `inconsistent`: the windows do
    not fit each other, and no sensor moved."""

    MOVED = "moved"
    SUSPECTED = "suspected"
    INCONSISTENT = "inconsistent"


def rig_alarms(rig: VehicleRig) -> Mapping[str, RigAlarm]:
    """The objection to each pair, by name; a pair that fits has none."""
    alarms = dict.fromkeys(misfits(rig), RigAlarm.INCONSISTENT)
    undecided = {sensor.name for sensor in rig.sensors if sensor.health is SensorHealth.UNDECIDED}
    for name in alarms:
        if {rig.graph.edge[name].a, rig.graph.edge[name].b} & undecided:
            alarms[name] = RigAlarm.SUSPECTED
    event = rig.event
    if event is not None:
        for name in pairs_of(rig.graph, event.sensors):
            if name not in rig.graph.of_lidars and not renewed(rig, name, event.stepped_ns):
                alarms[name] = RigAlarm.MOVED
    return alarms


def misfits(rig: VehicleRig) -> tuple[str, ...]:
    """Edges that do not fit the others: the only one at fault if there is one, else all on loops that do not close."""
    joint = rig.joint
    if joint is None or joint.consistent:
        return ()
    if joint.left_out is not None:
        return (joint.left_out,)
    named = {name for loop in joint.open_loops for name in loop.names} or set(joint.measured)
    return tuple(name for name in rig.graph.edge if name in named)
