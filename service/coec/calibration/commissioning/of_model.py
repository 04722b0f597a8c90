"""What commissioned vehicles of one model say about another one that is not commissioned yet."""

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
"""Fewer vehicles do not show how vehicles of the model differ."""


def model_baseline(baselines: Sequence[Baseline]) -> Baseline:
    """One baseline for all vehicles of a model. Their order does not matter.

    The estimator's bias is the mean over the vehicles; the bias of a further vehicle scatters about it as theirs do.
    The spread of a check is the average. Each limit is the widest of all vehicles, so that at its right pose no vehicle
    of these is flagged more often than by its own limit.

    Args:
        baselines: of one pair, one for each vehicle, commissioned with the same configuration and depth network.

    Returns:
        A baseline whose `T_camera_lidar` is the mean of theirs; `for_rig` replaces it by a vehicle's own.

    Raises:
        CalibrationError: fewer than `MIN_VEHICLES`, or baselines that do not belong together.
    """
    if len(baselines) < MIN_VEHICLES:
        raise CalibrationError(
            f"{len(baselines)} baselines: at least {MIN_VEHICLES} vehicles are needed to see how they differ"
        )
    for what, values in (
        ("pair", {one.pair for one in baselines}),
        ("number of degrees of freedom", {str(one.dof) for one in baselines}),
        ("depth network", {one.depth_identity for one in baselines}),
        ("configuration", {one.config_hash for one in baselines}),
    ):
        if len(values) > 1:
            raise CalibrationError(f"baselines of more than one {what}: {', '.join(sorted(values))}")
    # Sorted by content, so that rounding does not depend on the order in which they were given.
    several = sorted(baselines, key=lambda one: one.T_camera_lidar.tobytes() + one.rotation.bias.tobytes())
    first = several[0]
    offsets = [se3.difference(one.T_camera_lidar, first.T_camera_lidar) for one in several]
    return Baseline(
        pair=first.pair,
        T_camera_lidar=se3.perturb(first.T_camera_lidar, _mean(offsets)),
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
    """The baseline of a model, about the workshop calibration of one of its vehicles. The bias is known no better than
    on a rig of which only the camera is known, because no other vehicle shows how far this workshop calibration is
    off."""
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
    # The mean of so few vehicles is itself uncertain, by 1 / count of their variance.
    return Accuracy(
        bias=bias,
        bias_sigma=np.sqrt(variance * (1.0 + 1.0 / count)),
        spread=np.sqrt(_mean([one.spread**2 for one in several])),
    )


def _mean(values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.asarray(np.sum(np.array(values), axis=0) / len(values))


def _shared(several: Sequence[Baseline]) -> list[str]:
    """Names of the limits that all of them learned; the others stay as configured."""
    return sorted(set.intersection(*(set(one.limits) for one in several)))


def _widest(limit: str) -> Callable[[Iterable[float]], float]:
    """The function that picks, of several values of a limit, the one that refuses least; `limit` is its name."""
    return min if limit.startswith("min_") else max
