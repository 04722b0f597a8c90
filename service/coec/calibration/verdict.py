"""Whether an optimum may be believed: the paper's classifier, equation (2), on figures that need no knowledge of the
rig.

    failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim

Each figure is a ratio of the window to itself, so one set of limits serves any scene, network and number of bins until
a rig is commissioned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees, isfinite, radians
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.looks import Looks
from coec.calibration.confidence.loosened import LENS_FREE, Loosened
from coec.calibration.figures import FIGURES
from coec.calibration.frames.sampling import drives
from coec.calibration.objective.curvature import Curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.search.change_point import ChangePoint
from coec.calibration.types import INTRINSICS_OFF, MOVED, Decision, FramePair, Metric, Reason, StopReason, Verdict
from coec.config import VerdictConfig

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)
"""Places of both in ξ = [rx ry rz tx ty tz]."""

COUNTED = "range_edges"
"""A figure that counts what the frames show, and that counts the same thing again for each that shows it."""

UNCERTAIN = frozenset({"sigma_deg", "sigma_m", COUNTED})
"""Codes of reasons that more scenes would remedy."""


SAME_SCENE = 0.5
"""Share of the frames below which the independent looks of a window say that it saw one scene: of a drive through
streets they are worth seven tenths of their number and more, of slow traffic and motorways a fifth to a third, of a
standing vehicle a tenth to a quarter."""


def saw_one_scene(looks: float, frames: int) -> bool:
    """Whether frames that are worth so many independent `looks` show the same again and again, as those of a vehicle
    that stands do."""
    return looks < SAME_SCENE * frames


def counted_once(metrics: tuple[Metric, ...], looks: float, frames: int) -> tuple[Metric, ...]:
    """The metrics of an objective, with what frames have in common counted once, not in each of them. Where the number
    of independent `looks` is not known the frames are counted."""
    share = looks / frames if isfinite(looks) else 1.0
    return tuple(replace(m, value=m.value * share) if m.name == COUNTED else m for m in metrics)


def shape_metrics(
    evaluation: Evaluation, curvature: Curvature, sigma: NDArray[np.float64], limits: VerdictConfig
) -> tuple[Metric, ...]:
    """What any objective has to show at an optimum: no slope, a peak, standard deviations `sigma` (6,) worth the name,
    enough in view."""
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
    """What the likeliest change within the window gains over no change; nothing where changes were not looked for. A
    change of the scene gains nothing, nor does a turn below `min_change_deg`: scenes differ by that without a knock."""
    if change is None:
        return ()
    gain = change.gain if change.of_camera and degrees(change.turn_rad) >= limits.min_change_deg else 0.0
    return (Metric(MOVED, gain, limits.max_change_gain, at_least=False),)


def repetition_metric(looks: Looks | None, pairs: Sequence[FramePair], limits: VerdictConfig) -> tuple[Metric, ...]:
    """What the edges tell when all that frames have in common counts once; nothing where they were not looked at, or
    the vehicle is not known to drive. What stands still before a standing vehicle is its whole scene. What stands still
    before one that drives are the lines that run along its road, of which any two fit each other: on 25 simulated
    drives, most of them along motorways, they bring wrong poses to 13.7, and right ones that are accepted are at 29 and
    more."""
    if looks is None or not drives(pairs):
        return ()
    return (Metric("edges_once", looks.significance, limits.min_edges_once, at_least=True),)


def intrinsics_metric(loosened: Sequence[Loosened], limits: VerdictConfig) -> tuple[Metric, ...]:
    """How certainly another lens explains the window better than that of the rig; nothing where none was tried. One
    that moves the edges by less than matters gains nothing."""
    return tuple(
        Metric(
            INTRINSICS_OFF,
            one.certainty if one.matters else 0.0,
            limits.max_intrinsics_certainty,
            at_least=False,
        )
        for one in loosened
        if one.name == LENS_FREE
    )


def _newton_step(curvature: Curvature, axes: slice) -> float:
    """Largest |f'| / f'' over some axes, those not searched apart: how far away each axis alone puts its maximum;
    infinite without one."""
    first, second = curvature.first_derivative[axes], curvature.second_derivative[axes]
    first, second = first[np.isfinite(first)], second[np.isfinite(first)]
    return float(np.max(np.abs(first) / second)) if (second > 0.0).all() else float("inf")


def judge(
    metrics: tuple[Metric, ...],
    stop: StopReason,
    looks: float,
    frames: int,
    details: Mapping[str, str] = MappingProxyType({}),
) -> Verdict:
    """Equation (2) over the metrics of the objective and of its optimum. A window that is too uncertain because its
    `frames` are worth few independent `looks` is told to need motion past other things. `details` say more of what a
    metric means in this window, by its name."""
    reasons = [
        Reason(
            metric.name,
            f"{FIGURES[metric.name].fails}{details.get(metric.name, '')}: {metric.value:.3g}, limit {metric.limit:.3g}",
        )
        for metric in metrics
        if not metric.passed
    ]
    if stop is not StopReason.TOLERANCE:
        reasons.append(Reason(stop.value, "the search did not end inside its box: the true pose may lie outside"))
    if saw_one_scene(looks, frames) and any(reason.code in UNCERTAIN for reason in reasons):
        told = f"{frames} frames are worth {looks:.1f} independent ones: a window that passes other things tells more"
        reasons.append(Reason("motion", told))
    return Verdict(Decision.FAILED if reasons else Decision.ACCEPTED, metrics, tuple(reasons))
