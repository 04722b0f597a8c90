"""The published experiments on the method itself (Borer et al. 2023, sections 4.2 to 4.4), on any recording.

They use mutual information alone and the paper's own classifier, equation (2), so that what is new can be held against
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import normal_quantile
from coec.calibration.objective.curvature import measure_curvature
from coec.calibration.objective.mutual_information import Features, SearchBox, build_mutual_information
from coec.calibration.types import Matrix4, Rig
from coec.config import CalibrationConfig
from coec.geometry import se3

MOVES_DEG = (0.0, 1.0, 3.0)
"""Errors of the extrinsic at which the figures are taken."""

FALSE_ALARM_RATE = 0.01
"""Share of right poses that each of the three limits may refuse, a third each."""

SEED = 20_230_617


@dataclass(frozen=True, slots=True)
class Figures:
    """The three figures at one pose of one sample of pairs: MI (nats), largest |f'| (nats per radian) and least f''
    (nats per radian²) of the rotations."""

    moved_deg: float
    mi: float
    f1: float
    f2: float


@dataclass(frozen=True, slots=True)
class Limits:
    """Of equation (2)."""

    min_mi: float
    max_f1: float
    min_f2: float

    def flags(self, figures: Figures) -> bool:
        """Failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim."""
        return figures.mi < self.min_mi or figures.f1 > self.max_f1 or figures.f2 < self.min_f2


def failure_figures(
    frames: Sequence[Features],
    rig: Rig,
    right: Matrix4,
    config: CalibrationConfig,
    samples: int,
    heard: Callable[[int, int], None],
) -> list[Figures]:
    """The figures at the right pose and about it: `samples` times (seeded), on a random half of the frames and about a
    random axis.

    Raises:
        CalibrationError: no point can come into view.
    """
    found = []
    box = SearchBox(radians(max(MOVES_DEG) + 1.0), 0.0)
    for sample in range(samples):
        rng = np.random.default_rng([SEED, sample])
        chosen = sorted(rng.permutation(len(frames))[: max(len(frames) // 2, 1)].tolist())
        mutual = build_mutual_information([frames[i] for i in chosen], rig, right, box, config.objective)
        for moved_deg in MOVES_DEG:
            pose = se3.perturb(right, np.concatenate([radians(moved_deg) * _direction(rng), np.zeros(3)]))
            shape = measure_curvature(mutual, pose, 3)
            found.append(
                Figures(
                    moved_deg,
                    mutual.evaluate(pose).mi,
                    float(np.max(np.abs(shape.first_derivative[:3]))),
                    float(np.min(shape.second_derivative[:3])),
                )
            )
        heard(sample + 1, samples)
    return found


def learned(figures: Sequence[Figures]) -> Limits:
    """Limits from the figures at the right pose, at the false-alarm rate if they were normal."""
    right = np.array([(f.mi, f.f1, f.f2) for f in figures if f.moved_deg == 0.0])
    z = normal_quantile(1.0 - FALSE_ALARM_RATE / 3.0)
    mean, deviation = right.mean(axis=0), right.std(axis=0, ddof=1)
    return Limits(
        min_mi=float(mean[0] - z * deviation[0]),
        max_f1=float(mean[1] + z * deviation[1]),
        min_f2=float(mean[2] - z * deviation[2]),
    )


def slices(count: int, length: int) -> list[list[int]]:
    """Indices of neighbouring pairs: every run of `length` of `count`, in order."""
    return [list(range(first, first + length)) for first in range(max(count - length + 1, 1))]


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    drawn = rng.normal(size=3)
    return np.asarray(drawn / np.sqrt((drawn**2).sum()))
