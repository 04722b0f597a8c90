"""Answers about the rig, from a snapshot that the thread of the engine made. For any thread."""

from collections.abc import Callable
from math import degrees, isfinite, sqrt
from typing import cast

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.attribution import SensorHealth, SensorState
from coec.calibration.rig.graph import RigGraph, SensorKind
from coec.calibration.rig.joint_estimate import JointEstimate
from coec.calibration.rig.moved_sensors import Moved
from coec.calibration.rig.rig_estimator import MoveRecord, VehicleRig, pairs_of
from coec.calibration.types import Reason
from coec.geometry import se3
from coec.io.serialise import reasons_of, transform_of
from coec.io.zenoh.bus import Answer
from coec.schemas import rig_state
from coec.schemas.keys import Format, Keys
from coec.schemas.replies import Maybe6x6, Vector6
from coec.service.api.problems import rig_problems
from coec.service.api.reply_builders import SerializedReply
from coec.service.engine.rig import ONE_PAIR, LidarPairStatus, RigSnapshot


class RigAnswers:
    """The answers about the rig of one vehicle. `on_update` is for the thread of the engine, the rest for any."""

    def __init__(self, keys: Keys, publish: Callable[[str, Answer], None]) -> None:
        self._keys = keys
        self._publish = publish
        self._essence: object = None
        self._problems: dict[str, tuple[Reason, ...]] = {}
        self.on_update(RigSnapshot())

    def on_update(self, known: RigSnapshot) -> None:
        """Serialises the answer anew, and publishes it if it says something new about a sensor or about all of
        them."""
        self.reply = reply_of(self._keys.vehicle, known)
        self._snapshot = SerializedReply.of(self.reply)
        self._problems = {} if known.rig is None else rig_problems(known.rig)
        joint = self.reply.joint
        essence = (
            tuple((sensor.name, sensor.state, tuple(r.code for r in sensor.reasons)) for sensor in self.reply.sensors),
            None if joint is None else (joint.stamp_ns, joint.consistent),
            self.reply.correction,
            None if self.reply.move is None else (self.reply.move.since_ns, self.reply.move.over_ns),
            tuple((lidars.name, lidars.state) for lidars in self.reply.lidars),
            self.reply.reasons,
        )
        if essence != self._essence:
            first, self._essence = self._essence is None, essence
            if not first:
                self._publish(self._keys.rig, self._snapshot.answer("msgpack"))

    def answer(self, form: Format) -> Answer:
        """The reply, serialised in advance."""
        return self._snapshot.answer(form)

    def problems(self, pair: str) -> tuple[Reason, ...]:
        """Why the rig does not let a pair count as healthy, even if the pair is healthy by itself."""
        return self._problems.get(pair, ())


def reply_of(vehicle: str, known: RigSnapshot) -> rig_state.RigReply:
    """What is known of the rig in its wire form."""
    rig = known.rig
    posterior, last = (None, None) if rig is None else (rig.believed.posterior, rig.correction)
    if rig is not None:
        sensors = tuple(_sensor(rig, sensor) for sensor in rig.sensors)
    else:
        sensors = () if known.graph is None else _unknown_sensors(known.graph, known.why)
    return rig_state.RigReply(
        vehicle=vehicle,
        stamp_ns=None if rig is None else known.stamp_ns,
        sensors=sensors,
        nobody=None if posterior is None else _share(posterior.nobody),
        disturbed={} if posterior is None else {name: _share(p) for name, p in posterior.disturbed.items()},
        joint=None if rig is None or rig.joint is None else _joint(rig, rig.joint),
        correction=None
        if last is None or known.from_ns is None
        else rig_state.RigCorrection(
            stamp_ns=last.stamp_ns, from_ns=known.from_ns, sensors=last.sensors, pairs=tuple(last.pairs)
        ),
        move=None if rig is None or rig.move is None else _move(rig.move),
        lidars=tuple(_lidars(one) for one in known.lidars),
        reasons=reasons_of(known.why),
        looks={} if rig is None else dict(rig.observations),
        losses=dict(known.losses),
    )


def _unknown_sensors(graph: RigGraph, why: tuple[Reason, ...]) -> tuple[rig_state.SensorReply, ...]:
    """Replies for sensors of which nothing can be said."""
    undecided = ONE_PAIR in why
    return tuple(
        rig_state.SensorReply(
            name=sensor.name,
            kind="camera" if sensor.kind is SensorKind.CAMERA else "lidar",
            state="undecided" if undecided else "unknown",
            probability=None,
            since_ns=None,
            moved=None,
            pairs=_pairs(graph, sensor.name),
            reasons=reasons_of(why),
        )
        for sensor in graph.sensors
    )


def _sensor(rig: VehicleRig, sensor: SensorState) -> rig_state.SensorReply:
    unknown = sensor.health is SensorHealth.UNKNOWN
    moved = sensor.moved
    return rig_state.SensorReply(
        name=sensor.name,
        kind="camera" if sensor.kind is SensorKind.CAMERA else "lidar",
        state=sensor.health.value,
        probability=None if unknown else _share(sensor.probability),
        since_ns=rig.since_ns.get(sensor.name),
        moved=None if moved is None else _moved(moved),
        pairs=_pairs(rig.graph, sensor.name),
        reasons=reasons_of(sensor.reasons),
    )


def _move(move: MoveRecord) -> rig_state.RigMove:
    event = move.event
    return rig_state.RigMove(
        sensors=event.sensors,
        since_ns=event.since_ns,
        stepped_ns=event.stepped_ns,
        over_ns=move.over_ns,
        by={name: _moved(moved) for name, moved in move.moved.items()},
    )


def _moved(moved: Moved) -> rig_state.SensorMove:
    return rig_state.SensorMove(by=_degrees(moved.x), sigma=_degrees(np.sqrt(moved.covariance.diagonal())))


def _pairs(graph: RigGraph, sensor: str) -> tuple[str, ...]:
    """Pairs of a sensor that serve something, so no edges between LiDARs."""
    return tuple(name for name in pairs_of(graph, (sensor,)) if name not in graph.of_lidars)


def _lidars(known: LidarPairStatus) -> rig_state.LidarsReply:
    registration, edge = known.registration, known.edge
    pose = None if registration is None else registration.window.measurement.T_camera_lidar
    bias = None if registration is None else registration.range_bias
    return rig_state.LidarsReply(
        name=edge.name,
        a=edge.a,
        b=edge.b,
        state=known.state.value,
        reasons=reasons_of(known.reasons),
        stamp_ns=known.stamp_ns,
        measured_ns=None if registration is None else registration.observation.stamp_ns,
        a_from_b=None if pose is None else transform_of(pose),
        sigma=None if registration is None else _degrees(registration.window.measurement.uncertainty.sigma),
        correction=None if pose is None else _degrees(se3.difference(pose, edge.T_a_b)),
        range_bias_m=None if bias is None else bias.longer_m,
        range_bias_sigma_m=None if bias is None else bias.sigma_m,
        rms_m=None if registration is None or not isfinite(registration.rms_m) else registration.rms_m,
        share=None if registration is None else _share(registration.share),
        looks=known.registrations,
        losses=dict(known.losses),
    )


def _joint(rig: VehicleRig, joint: JointEstimate) -> rig_state.JointReply:
    pairs = []
    for edge in (edge for edge in rig.graph.edges if edge.name not in rig.graph.of_lidars):
        pose, covariance = joint.T_a_b[edge.name], joint.between(edge.name, edge.name)
        pairs.append(
            rig_state.JointPair(
                pair=edge.name,
                camera=edge.a,
                lidar=edge.b,
                measured=edge.name in joint.measured,
                camera_from_lidar=transform_of(pose),
                sigma=_degrees(np.array([sqrt(max(value, 0.0)) for value in covariance.diagonal().tolist()])),
                covariance=cast("Maybe6x6", tuple(tuple(row) for row in covariance.tolist())),
                step=_degrees(se3.difference(pose, rig.serves[edge.name].T_a_b)),
            )
        )
    loops = tuple(
        rig_state.OpenLoop(
            names=loop.names,
            rotation_deg=degrees(loop.rotation_rad),
            translation_m=loop.translation_m if isfinite(loop.translation_m) else None,
            p_value=_share(loop.chance),
        )
        for loop in joint.open_loops
        if isfinite(loop.rotation_rad)
    )
    return rig_state.JointReply(
        stamp_ns=joint.stamp_ns,
        pairs=tuple(pairs),
        chi2=max(joint.chi2, 0.0),
        freedom=joint.freedom,
        p_value=_share(joint.chance),
        consistent=joint.consistent,
        left_out=joint.left_out,
        open_loops=loops,
        widened=max(joint.widened, 1.0),
    )


def _degrees(values: NDArray[np.float64]) -> Vector6:
    numbers = values.tolist()
    return cast("Vector6", (*(degrees(value) for value in numbers[:3]), *numbers[3:]))


def _share(probability: float) -> float:
    """A probability, with rounding errors cut off to stay within 0 and 1."""
    return min(max(probability, 0.0), 1.0)
