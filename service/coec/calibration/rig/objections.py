"""What the rig has against a pair: one objection at a time, whatever is going on.

Windows of a rig that just moved do not fit those of before. While that is in question the objection is a suspicion;
once a sensor is named it is a move; only if neither holds do the pairs contradict each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.vehicle import VehicleRig, pairs_of, renewed


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
