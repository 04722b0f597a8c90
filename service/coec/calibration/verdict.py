"""Decides whether an optimum may be believed: the paper's classifier, equation (2), on figures that need no knowledge
of the rig.

    failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim

Each figure compares the window with itself. So one set of limits serves any scene, network and number of bins until a
rig is commissioned. `estimate_lens` reports what the window shows of the lens.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import degrees, hypot, inf, isfinite, isnan, radians, sqrt
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.figures import FIGURES
from coec.calibration.objective.edges import IndependentSamples
from coec.calibration.objective.fused import Scale
from coec.calibration.objective.landscape import Curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.search.change_point import ChangePoint
from coec.calibration.types import (
    INTRINSICS_OFF,
    MOVED,
    Decision,
    LensEstimate,
    Metric,
    MovedWithin,
    Reason,
    StopReason,
    Verdict,
    Window,
)
from coec.calibration.uncertainty import posterior
from coec.calibration.uncertainty.covariance import AssessedOptimum
from coec.config import CalibrationConfig, VerdictConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)
"""Places of rotation and translation in ξ = [rx ry rz tx ty tz]."""

COUNTED = "range_edges"
"""The figure that counts what the frames show; it counts the same thing again for each frame that shows it."""

EDGE_CONTRAST, RUNNER_UP = "edge_contrast", "runner_up"
"""The figure that says whether the edges fit better than at other poses."""

UNCERTAIN = frozenset({"sigma_deg", "sigma_m", COUNTED})
"""Codes of reasons that a window with more scenes would remedy."""


SAME_SCENE = 0.5
"""A window saw one scene if its independent samples are fewer than this share of its frames. See docs/measured.md."""


_CONTRADICTED = {posterior.CENTRE_OFF: "the held centre", posterior.CLOCKS_OFF: "the time offset"}
"""What is off under a hypothesis."""

CAUSES = frozenset({INTRINSICS_OFF, MOVED})
"""Codes of reasons that explain the others: they are named first."""

ONE_SCENE_CONTRAST = 1.2
"""Edge contrast that a window of one scene has to have, over that of other windows. See docs/measured.md."""

EVEN_CERTAINTY = 1.5
"""Certainty at which the intrinsics are as likely off as right: three standard deviations, each half a unit."""


def saw_one_scene(independent_samples: float, frames: int) -> bool:
    """Whether frames that are worth so many `independent_samples` show the same again and again, as those of a standing
    vehicle do."""
    return independent_samples < SAME_SCENE * frames


def counted_once(metrics: tuple[Metric, ...], independent_samples: float, frames: int) -> tuple[Metric, ...]:
    """The metrics of an objective, with what the frames have in common counted once, not once a frame. If the number of
    `independent_samples` is not finite, every frame counts."""
    share = independent_samples / frames if isfinite(independent_samples) else 1.0
    return tuple(replace(m, value=m.value * share) if m.name == COUNTED else m for m in metrics)


def shape_metrics(
    evaluation: Evaluation, curvature: Curvature, sigma: NDArray[np.float64], limits: VerdictConfig
) -> tuple[Metric, ...]:
    """What any objective has to show at an optimum: no slope, a peak, small standard deviations `sigma` (6,), and
    enough points in view."""
    peakedness = float(np.min(curvature.peakedness(evaluation.score))) * radians(1.0) ** 2
    metrics = [
        Metric(
            "newton_step_deg", degrees(_newton_step(curvature, ROTATION)), limits.max_newton_step_deg, at_least=False
        ),
        Metric("peakedness_per_deg2", peakedness, limits.min_peakedness_per_deg2, at_least=True),
        Metric("sigma_deg", degrees(float(np.max(sigma[ROTATION]))), limits.max_sigma_deg, at_least=False),
        Metric("overlap", evaluation.overlap, limits.min_overlap, at_least=True),
    ]
    if np.isfinite(curvature.first_derivative[TRANSLATION]).any():
        step_m = _newton_step(curvature, TRANSLATION)
        sigma_m = float(np.max(sigma[TRANSLATION][np.isfinite(curvature.first_derivative[TRANSLATION])]))
        metrics.append(Metric("newton_step_m", step_m, limits.max_newton_step_m, at_least=False))
        metrics.append(Metric("sigma_m", sigma_m, limits.max_sigma_m, at_least=False))
    return tuple(metrics)


def change_metric(change: ChangePoint | None, limits: VerdictConfig) -> tuple[Metric, ...]:
    """What the likeliest change within the window gains over no change; empty if nobody looked for a change. A change
    of the scene gains nothing. A turn below `min_change_deg` gains nothing either, because scenes differ by that much
    without a knock."""
    if change is None:
        return ()
    gain = change.gain if change.of_camera and degrees(change.turn_rad) >= limits.min_change_deg else 0.0
    return (Metric(MOVED, gain, limits.max_change_gain, at_least=False),)


def repetition_metric(independent_samples: IndependentSamples | None, limits: VerdictConfig) -> tuple[Metric, ...]:
    """How significant the edges are if all that frames have in common counts once, of fewer than ten frames as if they
    were ten such; empty if no edges were used.

    For a standing vehicle, what stands still in its images is the whole scene. For a driving one, what stands still are
    the lines along its road, and any two of those fit each other. See docs/measured.md.
    """
    if independent_samples is None:
        return ()
    return (Metric("edges_once", independent_samples.significance, limits.min_edges_once, at_least=True),)


def range_metric(range_significance: float | None, limits: VerdictConfig) -> tuple[Metric, ...]:
    """How significantly the range edges fit by themselves; empty if no edges were used.

    Markings and other edges of reflectance lie on the plane of the road, on which height, pitch and the position along
    the road trade against each other. See docs/measured.md.
    """
    if range_significance is None:
        return ()
    return (Metric("range_significance", range_significance, limits.min_range_significance, at_least=True),)


def intrinsics_metric(distribution: posterior.Posterior | None, limits: VerdictConfig) -> tuple[Metric, ...]:
    """How certainly another lens explains the window better than that of the rig; empty if none was tried.

    The logarithm of the odds as half the number of standard deviations that are worth as much, with even odds at
    `EVEN_CERTAINTY`.
    """
    if distribution is None:
        return ()
    nats = posterior.log_odds(distribution.probability(*posterior.OF_LENS))
    certainty = sqrt(max(EVEN_CERTAINTY**2 + 0.25 * nats, 0.0))
    return (Metric(INTRINSICS_OFF, certainty, limits.max_intrinsics_certainty, at_least=False),)


def on_the_sharpest(
    metrics: tuple[Metric, ...], evaluation: Evaluation, scale: Scale | None, optimum: AssessedOptimum
) -> tuple[Metric, ...]:
    """The metrics of an objective, with the edge contrast of its basin on blurred edges or on the sharpest ones,
    whichever is less: between boards and walls, blurred edges also fit where no sharp one does. A rival likewise is one
    only if it comes near on both, unless only the camera's centre is elsewhere: blurred edges are alike at both.

    The sharpest edges count at the optimum, where `evaluation` is that of the objective, or with lens, clocks and held
    centre at their most probable, whichever is larger. Where all is near, a held centre that is off by a centimetre
    displaces most edges by more than their width, and still the rotation is right.
    """
    if scale is None:
        return metrics
    contrast = evaluation.edge_contrast
    if optimum.posterior is not None:
        contrast = max(contrast, scale.standard(optimum.posterior.significance))
    sharp = {EDGE_CONTRAST: contrast}
    if optimum.rivals and contrast > 0.0:
        sharp[RUNNER_UP] = max(0.0, *map(scale.standard, optimum.rivals)) / contrast
    elsewhere = optimum.other_centre
    least = {} if elsewhere is None else {RUNNER_UP: elsewhere.significance}
    return tuple(
        replace(m, value=max(min(m.value, sharp.get(m.name, m.value)), least.get(m.name, -inf))) for m in metrics
    )


def _of_one_scene(metric: Metric) -> Metric:
    return replace(metric, limit=ONE_SCENE_CONTRAST * metric.limit) if metric.name == EDGE_CONTRAST else metric


def optimum_metrics(
    of_objective: tuple[Metric, ...],
    evaluation: Evaluation,
    scale: Scale | None,
    optimum: AssessedOptimum,
    change: ChangePoint | None,
    frames: int,
    config: CalibrationConfig,
) -> tuple[Metric, ...]:
    """All metrics of an optimum: those of its objective, of its shape, of its edges, and of a change within the window.
    `evaluation` is that of the objective at the optimum, `scale` that of its edges, `frames` the number of pairs.

    If translation is searched, what all frames have in common has to fit by itself, because a shift fits one near
    object, or lines along the road; and so have the range edges, because a shift fits markings. If not, the edge
    contrast of one scene, as of a single frame, has to be larger.
    """
    limits = config.verdict
    counted = counted_once(of_objective, optimum.uncertainty.independent_samples, frames)
    of_edges = on_the_sharpest(counted, evaluation, scale, optimum)
    repeats = config.search.dof == 6
    one_scene = frames == 1 or saw_one_scene(optimum.uncertainty.independent_samples, frames)
    return (
        *(map(_of_one_scene, of_edges) if one_scene and not repeats else of_edges),
        *shape_metrics(evaluation, optimum.curvature, optimum.sigma, limits),
        *(repetition_metric(optimum.independent, limits) if repeats else ()),
        *(range_metric(optimum.range_significance, limits) if repeats else ()),
        *intrinsics_metric(optimum.posterior, limits),
        *change_metric(change, limits),
    )


def reason_details(
    distribution: posterior.Posterior | None, moved: MovedWithin | None, window: Window
) -> Mapping[str, str]:
    """By the name of a metric, what its failure means in this window."""
    lens = _lens_text(distribution, window)
    return {
        "sigma_deg": "" if distribution is None else _contradictions_text(distribution, lens),
        INTRINSICS_OFF: f" ({lens})" if lens else "",
        MOVED: "" if moved is None else _move_text(moved, window),
    }


NOT_EXCLUDED = 0.05
"""Least probability of other intrinsics with which an uncertain rotation is said to come from them."""


def _contradictions_text(distribution: posterior.Posterior, lens: str) -> str:
    """Which assumptions the window contradicts, and by how much the camera turns without each; and the most probable
    other `lens`, if it does not exclude one."""
    turns = [
        f"estimating {_CONTRADICTED[one.name]}, too, turns it by "
        f"{degrees(float(np.linalg.norm((one.deviation - distribution.hypotheses[0].deviation)[:3]))):.1f}°"
        for one in distribution.hypotheses
        if one.name in _CONTRADICTED and one.probability >= 0.5
    ]
    of_lens = distribution.probability(*posterior.OF_LENS)
    if NOT_EXCLUDED <= of_lens < 0.5:
        turns.append(f"other intrinsics have a probability of {of_lens:.0%}: {lens}")
    return f" ({'; '.join(turns)})" if turns else ""


def _lens_text(distribution: posterior.Posterior | None, window: Window) -> str:
    """How the most probable other intrinsics differ from those of the rig; empty if none were tried."""
    lens = None if distribution is None else distribution.of(*posterior.OF_LENS)
    if lens is None:
        return ""
    (right, down, longer, _), camera = lens.lens.tolist(), window.rig.camera
    return (
        f"focal length {100.0 * longer:+.1f} %, principal point {right * camera.fx:+.1f} px right and "
        f"{down * camera.fy:+.1f} px down"
    )


def _move_text(moved: MovedWithin, window: Window) -> str:
    """By how much and when the camera moved."""
    turn_deg = degrees(se3.rotation_angle_rad(moved.T_after @ se3.inverse(moved.T_before)))
    before_s, after_s = (
        (stamp_ns - window.pairs[0].stamp_ns) / 1e9 for stamp_ns in (moved.last_before_ns, moved.first_after_ns)
    )
    return f", by {turn_deg:.1f}° between {before_s:.1f} and {after_s:.1f} s after its first pair"


def _newton_step(curvature: Curvature, axes: slice) -> float:
    """Largest |f'| / f'' over those of some axes that were searched: how far away each axis alone puts its maximum;
    infinite if one has no maximum."""
    first, second = curvature.first_derivative[axes], curvature.second_derivative[axes]
    first, second = first[np.isfinite(first)], second[np.isfinite(first)]
    return float(np.max(np.abs(first) / second)) if (second > 0.0).all() else float("inf")


_NAMES = (("pitch", "yaw", "roll"), ("position right", "position down", "position forward"))
"""Names of the turns about, and of the camera's place along, its axes."""


def _failure_text(metric: Metric, detail: str, sigma: NDArray[np.float64] | None) -> str:
    """What a metric beyond its limit means: with its value, its limit and their unit, for a σ by axis."""
    unit = FIGURES[metric.name].unit
    unit = unit if unit in ("", "°") else f" {unit}"
    if sigma is not None and metric.name in ("sigma_deg", "sigma_m"):
        turns = metric.name == "sigma_deg"
        values = np.degrees(sigma[ROTATION]) if turns else sigma[TRANSLATION]
        beyond = [
            (name, value)
            for name, value in zip(_NAMES[0 if turns else 1], values.tolist(), strict=True)
            if metric.limit < value < inf
        ]
        if beyond:
            verbs = ("is only known to", *["to"] * len(beyond))
            axes = (
                f"{name} {verb} ±{_above(value, metric.limit)}{unit}"
                for (name, value), verb in zip(beyond, verbs, strict=False)
            )
            return f"{', '.join(axes)}{detail}, limit {metric.limit:.2f}{unit}"
    value = "unknown" if isnan(metric.value) else f"{metric.value:.3g}{unit}"
    return f"{FIGURES[metric.name].fails}{detail}: {value}, limit {metric.limit:.3g}{unit}"


def _above(value: float, limit: float) -> str:
    """A value with two digits after the point, or as many as it takes to read as more than its limit."""
    digits = next((digits for digits in range(2, 6) if round(value, digits) > round(limit, 2)), 6)
    return f"{value:.{digits}f}"


def judge(
    metrics: tuple[Metric, ...],
    stop: StopReason,
    independent_samples: float,
    frames: int,
    details: Mapping[str, str] = MappingProxyType({}),
    sigma: NDArray[np.float64] | None = None,
) -> Verdict:
    """Equation (2) over the metrics of the objective and of its optimum. If a window is too uncertain because its
    `frames` are worth few `independent_samples`, one reason more says that it needs motion past other things. `details`
    holds, by the name of a metric, what its failure means in this window. From the standard deviations `sigma` (6,), a
    reason names the axes that are not known well enough."""
    reasons = [
        Reason(metric.name, _failure_text(metric, details.get(metric.name, ""), sigma))
        for metric in metrics
        if not metric.passed
    ]
    reasons.sort(key=lambda reason: reason.code not in CAUSES)
    if stop is not StopReason.TOLERANCE:
        reasons.append(
            Reason(stop.value, "the search did not converge within its bounds, so the true pose may lie outside")
        )
    if saw_one_scene(independent_samples, frames) and any(reason.code in UNCERTAIN for reason in reasons):
        count = f"{frames} frames are worth {independent_samples:.1f} independent samples"
        text = f"{count}: take a window while the vehicle drives past other objects"
        reasons.append(Reason("motion", text))
    return Verdict(Decision.FAILED if reasons else Decision.ACCEPTED, metrics, tuple(reasons))


DETERMINED = 1.0 / 3.0
"""A window determines what it knows to this share of the prior of a free lens: the prior then displaces it by no more
than a tenth."""


def estimate_lens(distribution: posterior.Posterior | None, camera: Camera) -> LensEstimate | None:
    """What the posterior of a window says of focal length, principal point and first radial term of a camera; None
    without a posterior.

    Each hypothesis has a lens of its own. The estimate is the mean of this mixture, so it stays with the intrinsics of
    the rig, within what is known of them, unless the window contradicts them. What the window says alone is the lens of
    the hypothesis whose lens is free.
    """
    free = None if distribution is None else distribution.of(posterior.LENS_OFF)
    if distribution is None or free is None:
        return None
    weights = np.array([one.probability for one in distribution.hypotheses])
    lenses = np.array([one.lens for one in distribution.hypotheses])
    variances = np.array([one.lens_sigma for one in distribution.hypotheses]) ** 2
    mean = np.einsum("h,hi->i", weights, lenses)
    spread = np.sqrt(np.einsum("h,hi->i", weights, variances + (lenses - mean) ** 2))
    unit = np.array([camera.fx, camera.fy, 1.0, 0.5 * hypot(camera.width, camera.height)])
    values = np.stack([mean, spread, free.lens, free.lens_sigma]) * unit
    if not np.isfinite(values).all():
        return None
    determined = free.lens_sigma <= DETERMINED * np.array(posterior.LENS_WRONG)
    difference, sigma, free_difference, free_sigma = values
    other = distribution.probability(*posterior.OF_LENS)
    return LensEstimate(difference, sigma, free_difference, free_sigma, determined, other)
