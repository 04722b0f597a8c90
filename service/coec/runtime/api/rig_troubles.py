"""Puts into words why the rig does not let a pair count as healthy."""

from __future__ import annotations

from math import degrees, isfinite

from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.joint import JointEstimate
from coec.calibration.rig.objections import RigAlarm, rig_alarms
from coec.calibration.rig.vehicle import VehicleRig
from coec.calibration.types import Reason

INCONSISTENT = "inconsistent_rig"
"""Code of the reason that a pair does not fit the others of its vehicle."""

MOVED = "sensor_moved"
"""Code of the reason that a sensor of the pair moved, and the pair serves the extrinsic from before."""

SUSPECTED = "sensor_suspected"
"""Code of the reason that the pair does not fit the others, and a sensor of it may have moved."""


def rig_problems(rig: VehicleRig) -> dict[str, tuple[Reason, ...]]:
    """A reason for each pair to which the rig objects, by pair; pairs that fit are left out."""
    return {pair: (_reason(rig, pair, objection),) for pair, objection in rig_alarms(rig).items()}


def _reason(rig: VehicleRig, pair: str, objection: RigAlarm) -> Reason:
    edge = rig.graph.edge[pair]
    if objection is RigAlarm.MOVED and rig.event is not None:
        moved = " and ".join(name for name in rig.event.sensors if name in (edge.a, edge.b))
        text = f"{moved} moved, and this pair still serves what was before; a window from after the move puts it right."
        return Reason(MOVED, text)
    if objection is RigAlarm.SUSPECTED:
        undecided = (one.name for one in rig.sensors if one.health is SensorHealth.UNDECIDED)
        may_be = " or ".join(name for name in undecided if name in (edge.a, edge.b))
        return Reason(
            SUSPECTED, f"{may_be} may have moved: the pairs of the vehicle do not agree; the next looks decide."
        )
    return Reason(INCONSISTENT, f"The pairs of the vehicle do not agree where its sensors are{_misfit(rig.joint)}.")


def _misfit(joint: JointEstimate | None) -> str:
    if joint is None:
        return ""
    odds = f"χ² {joint.chi2:.1f} at {joint.freedom} degrees of freedom, p {joint.chance:.1g}"
    if joint.left_out is not None:
        return f": its latest window does not fit those of the others, which fit each other without it ({odds})"
    if not joint.open_loops:
        return f": the latest windows of the pairs do not fit each other ({odds})"
    loop = joint.open_loops[0]
    shift = "" if not isfinite(loop.translation_m) else f" and {100.0 * loop.translation_m:.1f} cm"
    off = f"{degrees(loop.rotation_rad):.2f}°{shift}" if isfinite(loop.rotation_rad) else "more than chance"
    return f": the latest windows of {', '.join(loop.names)} should close a loop, and miss it by {off} ({odds})"
