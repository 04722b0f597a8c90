"""The status of a pair in `/diagnostics`: the only mapping from health, or from a result, to ROS levels and values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

from coec.schemas import replies
from coec.schemas.replies import ROS_LEVELS, CalibrationResult, HealthReply, MetricReply
from coec.schemas.rig_state import SensorReply, SensorState
from coec.schemas.ros_names import sensor_status_name, status_name

ServicePhase = Literal["starting", "running", "stopping", "failing"]
"""State of the whole service, as in `status`."""

UNITS: Final = ("deg", "deg", "deg", "m", "m", "m")
AXES: Final = ("rx", "ry", "rz", "tx", "ty", "tz")

MAX_MESSAGE: Final = 500
"""Most characters of the sentence, which panels show in one line; the values hold every reason in full."""


class DiagnosticLevel(IntEnum):
    """`diagnostic_msgs/DiagnosticStatus.level`."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """`diagnostic_msgs/DiagnosticStatus`."""

    level: DiagnosticLevel
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]


def hardware_id(vehicle: str, pair: str, serial: str | None) -> str:
    """The camera's serial number, or vehicle and pair if there is none."""
    return serial or f"{vehicle}/{pair}"


def level_of(health: HealthReply, service: ServicePhase) -> DiagnosticLevel:
    """The level of the state (`replies.ROS_LEVELS`), with exceptions: STALE if the reply is no longer renewed or the
    service stops, and at least ERROR if the service fails."""
    level = DiagnosticLevel(ROS_LEVELS[health.state])
    if service == "stopping" or any(reason.code == replies.SERVICE_STUCK for reason in health.reasons):
        return DiagnosticLevel.STALE
    return max(level, DiagnosticLevel.ERROR) if service == "failing" else level


def status_of_health(
    health: HealthReply, service: ServicePhase, serial: str | None, more: Mapping[str, str]
) -> DiagnosticStatus:
    """The status of a pair now. `more` holds values that health does not have."""
    return DiagnosticStatus(
        level_of(health, service),
        status_name(health.pair),
        _status_message(health, service),
        hardware_id(health.vehicle, health.pair, serial),
        {**_health_values(health), "service": service, **more},
    )


SENSOR_LEVELS: Final[Mapping[SensorState, DiagnosticLevel]] = {
    "calibrated": DiagnosticLevel.OK,
    "undecided": DiagnosticLevel.WARN,
    "camera_moved": DiagnosticLevel.ERROR,
    "lidar_moved": DiagnosticLevel.ERROR,
    "unknown": DiagnosticLevel.STALE,
}


def status_of_sensor(sensor: SensorReply, vehicle: str, service: ServicePhase) -> DiagnosticStatus:
    """The status of a sensor of a rig now; STALE if the service stops."""
    level = DiagnosticLevel.STALE if service == "stopping" else SENSOR_LEVELS[sensor.state]
    text = ": ".join([sensor.state, *(reason.text for reason in sensor.reasons[:1])])
    values = {"state": sensor.state, "kind": sensor.kind, "pairs": ", ".join(sensor.pairs), "service": service}
    values |= {f"reason {reason.code}": reason.text for reason in sensor.reasons}
    if sensor.probability is not None:
        values["probability of a move"] = f"{sensor.probability:.4g}"
    if sensor.since_ns is not None:
        values["since_ns"] = str(sensor.since_ns)
    if sensor.moved is not None:
        axes = zip(AXES, sensor.moved.by, sensor.moved.sigma, UNITS, strict=True)
        values["moved"] = ", ".join(f"{axis} {by:.3g} ± {sigma:.2g} {unit}" for axis, by, sigma, unit in axes)
    name = sensor_status_name(sensor.name)
    return DiagnosticStatus(level, name, text[:MAX_MESSAGE], hardware_id(vehicle, sensor.name, None), values)


def status_of_result(result: CalibrationResult) -> DiagnosticStatus:
    """The status in a window's file: an accepted result has the level of a healthy pair, a failed one that of a
    degraded pair."""
    reasons = result.verdict.reasons
    return DiagnosticStatus(
        DiagnosticLevel(ROS_LEVELS["degraded" if reasons else "healthy"]),
        status_name(result.pair),
        "; ".join(reason.text for reason in reasons) or "calibration accepted",
        hardware_id(result.vehicle, result.pair, None),
        {name: _figure_text(metric) for name, metric in result.metrics.items()},
    )


def _status_message(health: HealthReply, service: ServicePhase) -> str:
    """The state and its reasons in one line."""
    state = health.state if service in ("starting", "running") else f"{health.state}, service {service}"
    text = ": ".join([state, *(["; ".join(reason.text for reason in health.reasons)] if health.reasons else [])])
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE - 1]}…"


def _health_values(health: HealthReply) -> dict[str, str]:
    """Everything that health holds, one value each; unknown values are left out."""
    values = {"state": health.state, "since_ns": str(health.since_ns)}
    values |= {f"reason {reason.code}": reason.text for reason in health.reasons}
    values |= {f"need {number}": need for number, need in enumerate(health.needs, 1)}
    if health.age_s is not None:
        values["age_s"] = f"{health.age_s:.1f}"
    if health.evaluated_ns is not None:
        values["evaluated_ns"] = str(health.evaluated_ns)
    values |= {name: _figure_text(metric) for name, metric in health.metrics.items()}
    for name in AXES:
        axis: replies.AxisReply = getattr(health.axes, name)
        sigma = "unknown" if axis.sigma is None else f"{axis.sigma:.4g} {axis.unit}"
        values[f"axis {name}"] = f"{axis.status}, correction {axis.correction:.4g} {axis.unit}, sigma {sigma}"
    drifts = {"drift from commissioned": health.drift, "drift of the latest result": health.result_drift}
    for name, drift in drifts.items():
        if drift is not None:
            axes = zip(AXES, drift, UNITS, strict=True)
            values[name] = ", ".join(f"{axis} {value:.4g} {unit}" for axis, value, unit in axes if value is not None)
    quality = health.data_quality
    figures = {"pair_rate_hz": quality.pair_rate_hz, "sync_error_s": quality.sync_error_s}
    values |= {name: f"{value:.4g}" for name, value in figures.items() if value is not None}
    values["frozen_image"] = str(quality.frozen_image).lower()
    for place, causes in quality.drops.items():
        values |= {f"lost {place} {cause}": str(count) for cause, count in causes.items()}
    return values


def _figure_text(metric: MetricReply) -> str:
    value = "unknown" if metric.value is None else f"{metric.value:.6g}"
    if metric.limit is None:
        return value
    bound = "at least" if metric.at_least else "at most"
    return f"{value} ({bound} {metric.limit:.6g}, {'passed' if metric.passed else 'failed'})"
