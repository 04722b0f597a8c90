"""How well checks detect a wrong extrinsic: limits are learned on one stretch of a recording and tried on the rest,
with no pair in both.

Two classifiers are tried on the same checks: the distance of the local optimum, which decides, and for comparison the
paper's, equation (2). On pairs from which its limits were not learned, the paper's flagged 27 to 48 % of right poses of
KITTI-360, because mutual information depends on the scene as much as on the pose.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import normal_quantile
from coec.calibration.commissioning import learn_accuracy, learn_limits
from coec.calibration.monitor.check import Check, CheckInput, Expected, check_at, depth_cue
from coec.calibration.monitor.check_verdict import FALSE_ALARM_RATE, MIN_PAIRS, Opinion, opinion
from coec.calibration.types import Matrix4
from coec.config import CalibrationConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec_lab.experiments.evaluation_schema import DetectionRow

RIGHT = "right"
"""Name of the case without a move."""

MOVES = (
    (RIGHT, 0.0, 0.0),
    ("0.5 deg", radians(0.5), 0.0),
    ("1 deg", radians(1.0), 0.0),
    ("3 deg", radians(3.0), 0.0),
    ("10 cm", 0.0, 0.10),
)
"""By name: rotation about a random axis (rad), translation along a camera axis (m)."""

OBSERVABLE_M = 0.02
"""An axis of translation is observable where a check knows it to this standard deviation: 10 cm are five of them."""

MIN_RECORDED = 2 * MIN_PAIRS + 1
"""Fewest pairs of a recording that can be split: a check needs `MIN_PAIRS`, commissioning one more."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


CONFIDENCE = 0.95
"""Confidence of the interval of a share."""


@dataclass(frozen=True, slots=True, eq=False)
class TriedCheck:
    """One check: the move before it, and what both classifiers said."""

    name: str
    opinion: Opinion
    flagged_by_paper: bool
    check: Check


def require_enough(pairs: int) -> None:
    """Refuses a recording with too few pairs to split.

    Raises:
        CalibrationError: `pairs` is below `MIN_RECORDED`.
    """
    if pairs < MIN_RECORDED:
        raise CalibrationError(
            f"learning limits on half of the pairs and trying them on the others needs {MIN_RECORDED} pairs, "
            f"there are {pairs}"
        )


def try_detection(
    evidence: CheckInput,
    right: Matrix4,
    config: CalibrationConfig,
    splits: int,
    checks: int,
    on_progress: Callable[[int, int], None],
) -> list[TriedCheck]:
    """Cuts the pairs, taken as a ring, into two halves `splits` times (seeded), learns on one half, and tries `checks`
    checks after every move on the other; `heard(done, total)` counts the splits. `evidence` must be prepared for poses
    up to `FAR_RAD` from the right one.

    Raises:
        CalibrationError: fewer than `MIN_RECORDED` pairs.
    """
    count = len(evidence.pairs)
    require_enough(count)
    tried = []
    for split in range(splits):
        rng = np.random.default_rng([SEED, split])
        # Neighbouring pairs stay in one half, so that limits are tried at places where they were not learned.
        order = (int(rng.integers(count)) + np.arange(count)) % count
        learned, held_out = sorted(order[: (count + 1) // 2].tolist()), order[(count + 1) // 2 :].tolist()
        of_learned = evidence.of(learned)
        accuracies = learn_accuracy(of_learned, right)
        limits = learn_limits(of_learned, right, config, accuracies, FALSE_ALARM_RATE)
        expected = Expected(*(accuracy.expected for accuracy in accuracies))
        known = [axis for axis in range(3, 6) if accuracies[1].sigma(len(held_out))[axis] <= OBSERVABLE_M]
        for name, turn_rad, shift_m in MOVES:
            if shift_m > 0.0 and not known:
                continue
            for _ in range(checks):
                size = int(rng.integers(MIN_PAIRS, len(held_out) + 1))
                indices = sorted(rng.permutation(held_out)[:size].tolist())
                xi = _move(rng, turn_rad, shift_m, known)
                part, pose = evidence.of(indices), se3.perturb(right, xi)
                seen = check_at(part, pose, expected)
                by_paper = limits.of_paper.flags(depth_cue(part, seen, pose, config))
                tried.append(TriedCheck(name, opinion(seen, *accuracies, limits), by_paper, seen))
        on_progress(split + 1, splits)
    return tried


def table(tried: Sequence[TriedCheck]) -> tuple[DetectionRow, ...]:
    """The shares by move, in the order of `MOVES`. The interval holds as if no two checks shared a pair."""
    rows = []
    for name, _, _ in MOVES:
        of = [one for one in tried if one.name == name]
        if of:
            flagged = sum(one.opinion is Opinion.FLAGGED for one in of)
            low, high = interval(flagged, len(of))
            rows.append(
                DetectionRow(
                    name=name,
                    checks=len(of),
                    flagged=flagged / len(of),
                    flagged_low=low,
                    flagged_high=high,
                    undecided=sum(one.opinion is Opinion.UNDECIDED for one in of) / len(of),
                    flagged_by_paper=sum(one.flagged_by_paper for one in of) / len(of),
                )
            )
    return tuple(rows)


def interval(hits: int, of: int) -> tuple[float, float]:
    """Interval of the true share at `CONFIDENCE`, given `hits` in `of` draws (Wilson 1927). It also holds for no hit
    and for hits alone.

    Raises:
        ValueError: no sample was evaluated.
    """
    if of < 1:
        raise ValueError("no sample was evaluated")
    z = normal_quantile(0.5 + 0.5 * CONFIDENCE)
    share, shrink = hits / of, 1.0 + z * z / of
    middle = (share + 0.5 * z * z / of) / shrink
    half = z / shrink * sqrt(share * (1.0 - share) / of + 0.25 * z * z / of**2)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def _move(rng: np.random.Generator, turn_rad: float, shift_m: float, axes: Sequence[int]) -> NDArray[np.float64]:
    xi = np.zeros(6)
    xi[:3] = turn_rad * random_direction(rng)
    if shift_m > 0.0:
        xi[axes[int(rng.integers(len(axes)))]] = shift_m * float(rng.choice([-1.0, 1.0]))
    return xi
