"""Whether an optimum may be believed: the paper's classifier, equation (2), on figures that need no knowledge of the
rig.

    failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim

Each figure is a ratio of the window to itself, so one set of limits serves any scene, network and number of bins until
a rig is commissioned.
"""

from __future__ import annotations

from math import degrees, radians

import numpy as np

from coec.calibration.confidence import Curvature
from coec.calibration.objective import Evaluation
from coec.calibration.values import Decision, Metric, Reason, StopReason, Verdict
from coec.config import VerdictConfig

_MEANING = {
    "mi_over_unrelated": "depth and LiDAR agree no better than a cloud with the depth map of another frame",
    "newton_step_deg": "the objective is not at a maximum here",
    "peakedness_per_deg2": "the objective is too flat on at least one rotation axis",
    "overlap": "too few LiDAR points are in view",
}


def judge(
    evaluation: Evaluation, mi_of_unrelated: float, curvature: Curvature, stop: StopReason, limits: VerdictConfig
) -> Verdict:
    """Equation (2) over the optimum's evaluation, its curvature and the MI of unrelated frames (nats)."""
    first = curvature.first_derivative[:3]
    second = curvature.second_derivative[:3]
    newton_step_deg = degrees(float(np.max(np.abs(first) / second))) if (second > 0.0).all() else float("inf")
    peakedness = float(np.min(second)) * radians(1.0) ** 2 / max(evaluation.score, 1e-12)
    metrics = (
        Metric("mi_over_unrelated", evaluation.mi / max(mi_of_unrelated, 1e-12), limits.min_mi_over_unrelated, True),
        Metric("newton_step_deg", newton_step_deg, limits.max_newton_step_deg, False),
        Metric("peakedness_per_deg2", peakedness, limits.min_peakedness_per_deg2, True),
        Metric("overlap", evaluation.overlap, limits.min_overlap, True),
    )
    reasons = [
        Reason(metric.name, f"{_MEANING[metric.name]}: {metric.value:.3g}, limit {metric.limit:.3g}")
        for metric in metrics
        if not metric.passed
    ]
    if stop is not StopReason.TOLERANCE:
        reasons.append(Reason(stop.value, "the search did not end inside its box: the true pose may lie outside"))
    return Verdict(Decision.FAILED if reasons else Decision.ACCEPTED, metrics, tuple(reasons))
