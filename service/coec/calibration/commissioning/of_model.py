"""What commissioned vehicles of one model tell of another that is not commissioned yet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from math import fsum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import Accuracy, Baseline, MonitorLimits, uncommissioned
from coec.calibration.monitor.sensor_faults import SceneBaseline
from coec.calibration.types import Rig
from coec.errors import CalibrationError
from coec.geometry import se3

MIN_VEHICLES = 3
"""Fewer do not tell how vehicles of the model differ."""


def of_model(baselines: Sequence[Baseline]) -> Baseline:
    """One baseline for all vehicles of a model. Their order does not matter.

    The estimator's bias is the mean over the vehicles, and a further vehicle's lies about it as theirs do. A check
    spreads as on average, and a limit is that of the vehicle with the widest: none of the vehicles that taught it would
    be flagged by it at its right pose more often than by its own.

    Args:
        baselines: of one pair, a vehicle each, commissioned with one configuration and one depth network.

    Returns:
        A baseline whose `T_camera_lidar` is the mean of theirs; `for_rig` puts a vehicle's own in its place.

    Raises:
        CalibrationError: fewer than `MIN_VEHICLES`, or baselines that do not belong together.
    """
    if len(baselines) < MIN_VEHICLES:
        raise CalibrationError(f"{len(baselines)} baselines: at least {MIN_VEHICLES} vehicles tell how they differ")
    for what, found in (
        ("pair", {one.pair for one in baselines}),
        ("number of degrees of freedom", {str(one.dof) for one in baselines}),
        ("depth network", {one.depth_identity for one in baselines}),
        ("configuration", {one.config_hash for one in baselines}),
    ):
        if len(found) > 1:
            raise CalibrationError(f"baselines of more than one {what}: {', '.join(sorted(found))}")
    # Rounding follows an order that is theirs, and not the one in which they were named.
    several = sorted(baselines, key=lambda one: one.T_camera_lidar.tobytes() + one.rotation.bias.tobytes())
    first = several[0]
    apart = [se3.difference(one.T_camera_lidar, first.T_camera_lidar) for one in several]
    return Baseline(
        pair=first.pair,
        T_camera_lidar=se3.perturb(first.T_camera_lidar, _mean(apart)),
        rotation=_accuracy([one.rotation for one in several]),
        pose=_accuracy([one.pose for one in several]),
        dof=first.dof,
        limits={name: _widest(name)(one.limits[name] for one in several) for name in _shared(several)},
        monitor=MonitorLimits(
            **{
                field.name: _widest(field.name)(getattr(one.monitor, field.name) for one in several)
                for field in fields(MonitorLimits)
            }
        ),
        scene=SceneBaseline(
            gradient=_mean([one.scene.gradient for one in several]),
            bands=_mean([one.scene.bands for one in several]),
            sectors=_mean([one.scene.sectors for one in several]),
            range_edges=fsum(one.scene.range_edges for one in several) / len(several),
        ),
        false_alarm_rate=max(one.false_alarm_rate for one in several),
        windows=sum(one.windows for one in several),
        pairs=sum(one.pairs for one in several),
        detected={
            name: min(one.detected.get(name, 0.0) for one in several)
            for name in sorted({name for one in several for name in one.detected})
        },
        sensors={
            stream: sensor
            for stream, sensor in first.sensors.items()
            if all(one.sensors.get(stream) == sensor for one in several)
        },
        depth_identity=first.depth_identity,
        config_hash=first.config_hash,
    )


def for_rig(model: Baseline, rig: Rig) -> Baseline:
    """The baseline of a model, about the workshop calibration of one of its vehicles. Its bias is known no better than
    that of a rig of which only the camera is known: how far its own workshop calibration is off, no other vehicle
    tells."""
    rotation, pose = uncommissioned(rig.camera)
    return replace(
        model,
        T_camera_lidar=rig.T_camera_lidar_nominal,
        rotation=replace(model.rotation, bias_sigma=np.maximum(model.rotation.bias_sigma, rotation.bias_sigma)),
        pose=replace(model.pose, bias_sigma=np.maximum(model.pose.bias_sigma, pose.bias_sigma)),
    )


def _accuracy(several: Sequence[Accuracy]) -> Accuracy:
    count = len(several)
    bias = _mean([one.bias for one in several])
    variance = _mean([(one.bias - bias) ** 2 for one in several]) * count / (count - 1)
    # The mean of so few is itself uncertain by its share of how they differ.
    return Accuracy(
        bias=bias,
        bias_sigma=np.sqrt(variance * (1.0 + 1.0 / count)),
        spread=np.sqrt(_mean([one.spread**2 for one in several])),
    )


def _mean(values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.asarray(np.sum(np.array(values), axis=0) / len(values))


def _shared(several: Sequence[Baseline]) -> list[str]:
    """Limits of calibrations that all of them learned; the others stay as configured."""
    return sorted(set.intersection(*(set(one.limits) for one in several)))


def _widest(limit: str) -> Callable[[Iterable[float]], float]:
    """Of several values of a limit the one that refuses least; its name begins with what it bounds."""
    return min if limit.startswith("min_") else max
