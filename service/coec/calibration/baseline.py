"""The result of commissioning: how the estimator and the sensors behave on one rig, or on all vehicles of one model,
and the limits that follow, with those of equation (2) of Borer et al. 2023.

failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import fsum, inf, radians, sqrt
from statistics import NormalDist
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.sensor_faults import SceneBaseline
from coec.calibration.types import Matrix4, Rig
from coec.config import CalibrationConfig, VerdictConfig, config_hash
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, pixel_rad


def chi2_quantile(probability: float, dof: int) -> float:
    """Quantile of the χ² distribution, by the cube-root approximation of Wilson and Hilferty (1931): within 3 % from
    one degree of freedom and a probability of 0.9 on.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    h = 2.0 / (9.0 * dof)
    return dof * (1.0 - h + normal_quantile(probability) * sqrt(h)) ** 3


def poisson_most(confidence: float, events: int) -> float:
    """The mean of a Poisson variable that is `events` or fewer in one of 1 / (1 - confidence) draws: the upper
    confidence limit for a mean when so many events were seen (Garwood 1936).

    Raises:
        ValueError: the confidence is not between 0 and 1.
    """
    return 0.5 * chi2_quantile(confidence, 2 * (events + 1))


def distance2_quantile(probability: float, dof: int, known_by: int) -> float:
    """Quantile of the squared distance of one more draw in `dof` axes from a mean, in standard deviations that were
    estimated with `known_by` degrees of freedom: `dof` times the F distribution, by the approximation of Paulson
    (1942). If the estimate is from few draws, one more draw lies farther out than χ² says.

    Raises:
        ValueError: the probability is not between 0 and 1, or `known_by` is too small for so rare a quantile.
    """
    z = normal_quantile(probability)
    g, h = 2.0 / (9.0 * dof), 2.0 / (9.0 * known_by)
    a, b = 1.0 - h, 1.0 - g
    left = a * a - z * z * h
    if left <= 0.0:
        raise ValueError(f"{known_by} degrees of freedom determine no quantile of {probability}")
    root = (a * b + sqrt(a * a * b * b - left * (b * b - z * z * g))) / left
    return dof * root**3


def normal_quantile(probability: float) -> float:
    """Quantile of the standard normal distribution.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"a quantile needs a probability between 0 and 1, got {probability}")
    return NormalDist().inv_cdf(probability)


class PaperFigures(Protocol):
    """The three figures at a pose."""

    @property
    def mi(self) -> float:
        """Equation (1), nats."""

    @property
    def f1(self) -> float:
        """Largest slope of the rotations, nats per radian."""

    @property
    def f2(self) -> float:
        """Least peakedness of the rotations, nats per radian²."""


@dataclass(frozen=True, slots=True)
class PaperLimits:
    """Limits of the three figures, in their units; the defaults refuse nothing."""

    min_mi: float = -inf
    max_f1: float = inf
    min_f2: float = -inf

    def flags(self, figures: PaperFigures) -> bool:
        """Whether equation (2) says failed."""
        return figures.mi < self.min_mi or figures.f1 > self.max_f1 or figures.f2 < self.min_f2

    @classmethod
    def learned(cls, right: Sequence[PaperFigures], false_alarm_rate: float) -> PaperLimits:
        """Limits that refuse this share of right poses, a third of it by each figure, if the figures of `right` (at
        least two) are samples of a normal distribution."""
        z = normal_quantile(1.0 - false_alarm_rate / 3.0)
        return cls(
            min_mi=beyond([figures.mi for figures in right], -z),
            max_f1=beyond([figures.f1 for figures in right], z),
            min_f2=beyond([figures.f2 for figures in right], -z),
        )


def beyond(values: Sequence[float], z: float) -> float:
    """The value that lies z standard deviations from the mean."""
    return float(np.mean(values) + z * np.std(values, ddof=1))


FLOOR = np.array([radians(0.02)] * 3 + [0.004] * 3)
"""Least standard deviation of any check: the error that the interpolation of the edge maps leaves (rad, m)."""

PRIOR_SPREAD_ROTATION = np.array([radians(0.08), radians(0.07), radians(0.15), np.nan, np.nan, np.nan])
PRIOR_SPREAD_POSE = np.array([radians(0.20), radians(0.10), radians(0.25), 0.02, 0.04, 0.04])
"""Spread of a check of a single pair over three and over six degrees of freedom (rad, m). See docs/measured.md."""

UNCOMMISSIONED_BIAS = np.array([radians(0.12)] * 3 + [0.03] * 3)
"""Standard deviation of the estimator's unknown bias on a rig that was not commissioned (rad, m). See
docs/measured.md."""

STREET = np.array([radians(0.04)] * 3 + [0.01] * 3)
"""Standard deviation of the pose from street to street (rad, m). See docs/measured.md."""

PIXEL_SHARE = 0.3
"""Share of a pixel by which pixels alone may displace the local optimum, whatever the scenes of a commissioning show.
See docs/measured.md."""

FIGURES = "edges-insist"
"""Names the figures for which limits are learned; part of the hash that says what a baseline is valid for. It changes
when a check of the same pairs gives other figures, because limits learned before would not fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """How far the local optimum of a check lies from a right pose: the `bias` (6,), known to `bias_sigma` (6,), and the
    `spread` (6,) of a check of one pair (rad, m). NaN on axes that the check does not search."""

    bias: NDArray[np.float64]
    bias_sigma: NDArray[np.float64]
    spread: NDArray[np.float64]

    @property
    def expected(self) -> NDArray[np.float64]:
        """(6,) the bias; zero on axes that are not searched."""
        return np.nan_to_num(self.bias)

    def sigma(self, pairs: int) -> NDArray[np.float64]:
        """(6,) standard deviation of the offset of a check of so many pairs, after the bias is subtracted."""
        variance = self.spread**2 / max(pairs, 1) + self.bias_sigma**2 + FLOOR**2
        return np.asarray(np.sqrt(variance))

    def noise(self, pairs: int) -> NDArray[np.float64]:
        """(6,) the part of that standard deviation which is new at every check."""
        return np.asarray(np.sqrt(self.spread**2 / max(pairs, 1) + FLOOR**2))

    def distance2(self, offset: NDArray[np.float64], pairs: int) -> float:
        """Squared distance of an offset (6,) from the bias in standard deviations, over the axes that were searched."""
        return fsum(self._squares(offset, pairs))

    def farthest2(self, offset: NDArray[np.float64], pairs: int) -> float:
        """Squared distance of an offset (6,) from the bias on the axis where it is farthest, in standard deviations, so
        that five axes that are right do not hide one that is off."""
        return max(self._squares(offset, pairs))

    def _squares(self, offset: NDArray[np.float64], pairs: int) -> list[float]:
        standard = (offset - self.bias) / self.sigma(pairs)
        return [float(s) ** 2 for s in standard if np.isfinite(s)]


@dataclass(frozen=True, slots=True)
class MonitorLimits:
    """The limits of a check. The paper's three refuse nothing until they are learned.

    Attributes:
        max_distance2_rotation: squared distance of the local optimum over rotations, in standard deviations.
        max_farthest2_pose: squared distance of the local optimum over six degrees of freedom, on the axis that is
            farthest off, likewise.
        min_edges_per_pair: significance of the edges at the local optimum, over the root of the number of pairs.
        insisted_share: share of these two distance limits beyond which an optimum is too far off if the edges insist.
        max_agreement_rad: angle between the local optima of the two cues.
        min_overlap: points in view over the most that any pose within reach sees.
        min_mi, max_f1, min_f2: equation (2) of Borer et al. 2023: nats, per radian, per radian².
    """

    max_distance2_rotation: float
    max_farthest2_pose: float
    min_edges_per_pair: float
    insisted_share: float = 1.0
    max_agreement_rad: float = inf
    min_overlap: float = 0.5
    min_mi: float = -inf
    max_f1: float = inf
    min_f2: float = -inf

    @property
    def of_paper(self) -> PaperLimits:
        """The limits of equation (2)."""
        return PaperLimits(self.min_mi, self.max_f1, self.min_f2)


def pixel_floor(camera: Camera) -> NDArray[np.float64]:
    """(6,) standard deviation that the pixels of a camera cause in any check, however many pairs it has (rad, m)."""
    off_rad = PIXEL_SHARE * pixel_rad(camera)
    return se3.axis_steps(off_rad)


def street_sigma(camera: Camera) -> NDArray[np.float64]:
    """(6,) standard deviation of the error that all checks of one street have in common (rad, m)."""
    return np.asarray(np.hypot(STREET, pixel_floor(camera)))


def uncommissioned(camera: Camera) -> tuple[Accuracy, Accuracy]:
    """The accuracy of checks over three and over six degrees of freedom on a rig of which only the camera is known."""
    bias_sigma = np.sqrt(UNCOMMISSIONED_BIAS**2 + pixel_floor(camera) ** 2)
    rotation = Accuracy(np.array([0.0] * 3 + [np.nan] * 3), bias_sigma, PRIOR_SPREAD_ROTATION)
    return rotation, Accuracy(np.zeros(6), bias_sigma, PRIOR_SPREAD_POSE)


@dataclass(frozen=True, slots=True, eq=False)
class Baseline:
    """A commissioned rig.

    Attributes:
        T_camera_lidar: (4, 4) the reference: the workshop calibration, or the current one when it was commissioned.
        rotation, pose: how checks over three and over six degrees of freedom lie about the reference.
        dof: degrees of freedom of the calibrations of this rig; decides which of the two gives `bias`.
        limits: learned limits, by the names of `VerdictConfig`.
        monitor: learned limits of a check.
        false_alarm_rate: largest share of checks at a right pose that the limits are meant to flag.
        windows, pairs: from how many of each it was learned.
        detected: share of checks that were flagged after the reference was moved, by the amount, such as `0.5 deg`.
        sensors: what identifies the sensors, by stream: serial numbers where known, else frame ids.
        depth_identity, config_hash: of the calibrations for which it is valid.
    """

    pair: str
    T_camera_lidar: Matrix4
    rotation: Accuracy
    pose: Accuracy
    dof: int
    limits: dict[str, float]
    monitor: MonitorLimits
    scene: SceneBaseline
    false_alarm_rate: float
    windows: int
    pairs: int
    detected: dict[str, float]
    sensors: dict[str, str]
    depth_identity: str
    config_hash: str

    @property
    def accuracy(self) -> Accuracy:
        """The accuracy for the degrees of freedom that calibrations of this rig search."""
        return self.rotation if self.dof == 3 else self.pose

    @property
    def bias(self) -> NDArray[np.float64]:
        """(6,) the estimator's optimum less the reference (rad, m); zero on axes that are not searched."""
        return self.accuracy.expected

    @property
    def bias_sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviation of the bias; NaN on axes that are not searched."""
        return self.accuracy.bias_sigma

    def verdict(self, config: VerdictConfig) -> VerdictConfig:
        """The configuration with the limits that were learned."""
        return config.model_copy(update=self.limits)

    def unbiased(self, T_camera_lidar: Matrix4) -> Matrix4:
        """An estimate (4, 4) without the bias of the estimator on this rig. Only that may be served, or compared with
        the workshop calibration."""
        return np.asarray(se3.inverse(se3.perturb(np.eye(4), self.bias)) @ T_camera_lidar)


@dataclass(frozen=True, slots=True, eq=False)
class BaselineDrift:
    """Distance from the commissioned calibration: ξ (6,) and its standard deviation (6,), rad and m; NaN where not
    estimated."""

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]


def drift(T_camera_lidar: Matrix4, sigma: NDArray[np.float64], baseline: Baseline) -> BaselineDrift:
    """How far an estimate (4, 4) with standard deviations (6,) lies from the commissioned calibration. The estimator's
    bias on the rig is removed, and the uncertainty of the bias is included."""
    value = se3.difference(T_camera_lidar, baseline.T_camera_lidar) - baseline.bias
    return BaselineDrift(value, np.asarray(np.sqrt(sigma**2 + np.nan_to_num(baseline.bias_sigma) ** 2)))


def mismatch(baseline: Baseline, rig: Rig, depth_identity: str, config_hash: str) -> str | None:
    """Why a baseline is not valid for a rig and its configuration, in one sentence; None if it is valid."""
    if baseline.pair != rig.pair:
        return f"It was made for the pair {baseline.pair}."
    for stream, frame in (("camera", rig.camera_frame), ("lidar", rig.lidar_frame)):
        if f"{stream}_frame" in baseline.sensors and baseline.sensors[f"{stream}_frame"] != frame:
            return f"It was made with the {stream} {baseline.sensors[f'{stream}_frame']}."
    if baseline.depth_identity != depth_identity:
        return "It was made with another depth network."
    if baseline.config_hash != config_hash:
        return "It was made with another configuration of the calibration."
    if unknown := sorted(set(baseline.limits) - set(VerdictConfig.model_fields)):
        return f"It holds limits of figures that no longer exist: {', '.join(unknown)}."
    return None


def learned_hash(config: CalibrationConfig) -> str:
    """Hash of the configuration for which a baseline is valid: all that moves an optimum. Limits are not part of it,
    because the baseline replaces them."""
    return config_hash(config.objective, config.search, str(config.motion_compensation), FIGURES)


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
