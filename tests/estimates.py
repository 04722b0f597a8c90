"""Estimates that nobody computed, for what keeps and serves them."""

from __future__ import annotations

import numpy as np

from coec.calibration.types import Decision, Estimate, Metric, Optimum, Rig, StopReason, Uncertainty, Verdict
from coec.geometry import se3
from coec.geometry.cameras import build

ESTIMATE_RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    se3.perturbation(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])),
    np.eye(4),
)


def estimate(window: int, decision: Decision = Decision.ACCEPTED) -> Estimate:
    """Every number drawn from the seed `window`, which is its stamp, too."""
    rng = np.random.default_rng(window)
    return Estimate(
        window_id=f"front-{window}",
        data_stamp_ns=window,
        pairs=3,
        optimum=Optimum(
            se3.perturbation(rng.normal(size=6)),
            score=float(rng.normal()),
            score_at_start=float(rng.normal()),
            mi=float(rng.normal()),
            overlap=float(rng.normal()),
            points_in_view=5,
            evaluations=6,
            stop_reason=StopReason.TOLERANCE,
            first_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
            second_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
        ),
        verdict=Verdict(decision, (Metric("mi", 1 / 3, 0.1, True),), ()),
        correction=rng.normal(size=6),
        uncertainty=Uncertainty.unknown(),
        solved=np.arange(6) < 3,
        unobservable=np.zeros(6, np.bool_),
        compensation={"done": 3},
        depth_identity="precomputed",
        config_hash="c" * 16,
    )
