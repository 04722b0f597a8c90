"""The published experiments on the method itself (Borer et al. 2023, sections 4.2 to 4.4), on any recording.

They use mutual information alone and the paper's own classifier, equation (2), so that what is new here can be compared
with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from coec.calibration.commissioning.equation_2 import PaperLimits
from coec.calibration.objective.curvature import measure_curvature
from coec.calibration.objective.mutual_information import Features, SearchBox, build_mutual_information
from coec.calibration.types import Matrix4, Rig
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.vectors import random_direction

MOVES_DEG = (0.0, 1.0, 3.0)
"""Errors of the extrinsic at which the figures are taken, degrees: those of the paper."""

FALSE_ALARM_RATE = 0.01
"""Share of right poses that the three limits together may refuse, a third each."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


@dataclass(frozen=True, slots=True)
class FailureFigures:
    """The three figures at one pose of one sample of pairs: MI (nats), largest |f'| (nats per radian) and least f''
    (nats per radian²) of the rotations."""

    moved_deg: float
    mi: float
    f1: float
    f2: float


def failure_figures(
    frames: Sequence[Features],
    rig: Rig,
    right: Matrix4,
    config: CalibrationConfig,
    samples: int,
    on_progress: Callable[[int, int], None],
) -> list[FailureFigures]:
    """The figures at the right pose and about it: `samples` times (seeded), on a random half of the frames and about a
    random axis.

    Raises:
        CalibrationError: no point can come into view.
    """
    figures = []
    box = SearchBox(radians(max(MOVES_DEG) + 1.0), 0.0)
    for sample in range(samples):
        rng = np.random.default_rng([SEED, sample])
        sampled = sorted(rng.permutation(len(frames))[: max(len(frames) // 2, 1)].tolist())
        mutual = build_mutual_information([frames[i] for i in sampled], rig, right, box, config.objective)
        for moved_deg in MOVES_DEG:
            pose = se3.perturb(right, np.concatenate([radians(moved_deg) * random_direction(rng), np.zeros(3)]))
            shape = measure_curvature(mutual, pose, 3)
            figures.append(
                FailureFigures(
                    moved_deg,
                    mutual.evaluate(pose).mi,
                    float(np.max(np.abs(shape.first_derivative[:3]))),
                    float(np.min(shape.second_derivative[:3])),
                )
            )
        on_progress(sample + 1, samples)
    return figures


def learned(figures: Sequence[FailureFigures]) -> PaperLimits:
    """Limits from the figures at the right pose."""
    return PaperLimits.learned([f for f in figures if f.moved_deg == 0.0], FALSE_ALARM_RATE)


def slices(count: int, length: int) -> list[list[int]]:
    """Indices of neighbouring pairs: every run of `length` out of `count`, in order."""
    return [list(range(first, first + length)) for first in range(max(count - length + 1, 1))]
