"""The statistics of an evaluation to its wire model: degrees instead of radians, null instead of NaN."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict
from math import degrees
from typing import cast

import numpy as np
from numpy.typing import NDArray

from coec.calibration import evaluation
from coec.schemas import replies


def spread_of(spread: evaluation.Spread, scale: float = 1.0) -> replies.Spread:
    """The spread of a figure, times `scale`."""
    return replies.Spread(
        median=_number(scale * spread.median), p95=_number(scale * spread.p95), max=_number(scale * spread.max)
    )


def angle_spread_of(spread_rad: evaluation.Spread) -> replies.Spread:
    """The spread of an angle, radians, in degrees."""
    return spread_of(spread_rad, degrees(1.0))


def verdicts_of(verdicts: evaluation.Verdicts) -> replies.VerdictCounts:
    """The same counts."""
    return replies.VerdictCounts(**asdict(verdicts))


def frames_point_of(point: evaluation.FramesPoint) -> replies.FramesPoint:
    """Errors of windows of one number of frames."""
    return replies.FramesPoint(
        frames=point.frames,
        subsets=point.subsets,
        hit_rate=point.hit_rate,
        rotation_deg=angle_spread_of(point.rotation_rad),
        translation_m=spread_of(point.translation_m),
    )


def in_degrees(rad_m: NDArray[np.float64]) -> replies.Maybe6:
    """(6,) radians and metres in degrees and metres, null where there is no figure."""
    return cast("replies.Maybe6", tuple(_numbers(np.concatenate([np.degrees(rad_m[:3]), rad_m[3:]]))))


def _numbers(values: Iterable[float]) -> list[float | None]:
    return [_number(float(value)) for value in values]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
