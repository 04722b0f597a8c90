"""Where the solves of an evaluation start, and on which frames: the protocol of Borer et al., WACV 2024 (METHOD,
section 2). No random number decides a start, so that two evaluations differ only by what they evaluate.
"""

from __future__ import annotations

from math import gcd, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry import se3

GOLDEN_ANGLE_RAD = pi * (3.0 - sqrt(5.0))
"""The turn between neighbours of a Fibonacci lattice (Á. González, "Measurement of areas on a sphere using Fibonacci
and latitude-longitude lattices", 2010)."""

GOLDEN_RATIO = (1.0 + sqrt(5.0)) / 2.0

COUNTS_PER_DECADE = (1, 2, 3, 5, 7)
"""Numbers of frames that are tried in every decade: steps of a factor of 1.4 to 2, about even on a logarithmic axis."""

SUBSET_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


def sphere_directions(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors, evenly spread: the Fibonacci sphere about the third axis, from +1 down to -1.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"a sphere needs at least one direction, got {count}")
    index = np.arange(count)
    along = 1.0 - (2.0 * index + 1.0) / count
    across = np.sqrt(1.0 - along * along)
    azimuth = index * GOLDEN_ANGLE_RAD
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), along])


def translation_partners(count: int) -> NDArray[np.int64]:
    """(count,) a permutation: j = (k·i + c) mod count, with c = ⌊count/2⌋ and k the number nearest to count / golden
    ratio (the smaller of two) that is coprime to count.

    So neighbouring rotations get translations from all over the sphere, and every direction is used once.
    """
    ideal_step = count / GOLDEN_RATIO
    coprime = [k for k in range(1, max(count, 2)) if gcd(k, count) == 1]
    step = min(coprime, key=lambda k: (abs(k - ideal_step), k))
    return (step * np.arange(count, dtype=np.int64) + count // 2) % count


def perturbations(count: int, rotation_rad: float, translation_m: float) -> NDArray[np.float64]:
    """(count, 6) ξ: rotation vector R·d_i about the camera axes and translation T·d_j, where j is the partner of i."""
    sphere = sphere_directions(count)
    return np.hstack([rotation_rad * sphere, translation_m * sphere[translation_partners(count)]])


def start_poses(reference: Matrix4, count: int, rotation_rad: float, translation_m: float) -> list[Matrix4]:
    """The reference (4, 4) moved by every perturbation, on the left."""
    return [se3.perturb(reference, xi) for xi in perturbations(count, rotation_rad, translation_m)]


def frame_counts(available: int) -> list[int]:
    """1, 2, 3, 5, 7, 10, 20, 30, ... and all: ascending, none above `available`."""
    counts = {available}
    decade = 1
    while decade <= available:
        counts.update(decade * step for step in COUNTS_PER_DECADE if decade * step <= available)
        decade *= 10
    return sorted(counts)


def frame_subset(available: int, size: int, trial: int) -> list[int]:
    """`wanted` of `available` indices, ascending, drawn without repetition. `wanted` and `trial` seed the draw, so that
    trials differ and evaluations repeat."""
    sampled = np.random.default_rng([SUBSET_SEED, size, trial]).choice(available, size=size, replace=False)
    return sorted(int(index) for index in sampled)
