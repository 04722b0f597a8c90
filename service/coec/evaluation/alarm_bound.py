"""How often the monitor would accuse a right mount, estimated from fewer hours of driving than one false alarm takes.

No single check accuses a mount. What accuses it is a place where all checks are off alike, far enough and for long
enough. So there are two questions. First, how far off are places? Rendered drives give the displacement of each drive
on its farthest axis, in standard deviations of `place`; beyond what was seen a tail is fitted (peaks over threshold:
Pickands 1975; Smith 1987), and all tails count by their likelihood. Second, what does the detector do at a place that
far off? It is run on drawn places of one displacement, where checks scatter as they did on one of the rendered drives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.change_detector import doubtful_after
from coec.schemas.checks import Judged

SETTLED_BEFORE_PLACE = 24
"""Checks of a right mount before a place: two minutes at one every five seconds."""

DISPLACEMENTS = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0)
"""Displacements of drawn places, in standard deviations of `place`: from one that every second place has to one that
every check sees."""

DRAWS = 12
"""Places of each displacement."""

MIN_CHECKS = 3
"""Clear checks from which a place is known: fewer do not tell a place that is off from a bad check."""

MIN_PLACES = 20
"""With fewer places no tail is fitted, because only half of them lie beyond the threshold."""

TAIL_SHAPES = np.linspace(-0.5, 0.5, 41)
"""Shapes of the tails considered, all equally likely beforehand: from a tail that ends soon after what was seen to one
without a variance."""

TAIL_SCALES = np.geomspace(0.05, 20.0, 121)
"""Scales of the tails considered, over the mean excess; every factor is equally likely beforehand."""

BOUND_CONFIDENCE = 0.95
"""Confidence of the bound."""

PLACE_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

Alarms = Callable[[Sequence[Judged]], bool]
"""Whether a detector accuses the mount in a sequence of checks."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceChecks:
    """What clear checks of a right mount say about the places where they were made.

    Attributes:
        checks: of every place, the checks that can tell.
        displacement: (n,) of every place: the median of its checks on the axis that is farthest off, in standard
            deviations of `place` in such a scene. By the median, one outlying check displaces no place.
    """

    checks: tuple[tuple[Judged, ...], ...]
    displacement: NDArray[np.float64]

    @classmethod
    def from_drives(cls, drives: Sequence[Sequence[Judged]]) -> PlaceChecks:
        """Every drive is one place; drives with fewer than `MIN_CHECKS` clear checks are left out."""
        eligible = tuple(checks for checks in map(_clear, drives) if len(checks) >= MIN_CHECKS)
        far = [float(np.max(np.abs(_centre(checks)) / _place_sigma(checks))) for checks in eligible]
        return cls(eligible, np.array(far))


@dataclass(frozen=True, slots=True)
class Bound:
    """False alarms in 100 hours: the mean over all likely tails of displacements, and the upper bound at `CONFIDENCE`.
    `half` is the displacement from which half of the places accuse; None if not even the largest does."""

    mean: float
    at_most: float
    half: float | None


def _clear(drive: Sequence[Judged]) -> tuple[Judged, ...]:
    """The checks of a drive that may accuse."""
    clear: list[Judged] = []
    doubtful = 0.0
    for check in drive:
        if not check.causes and not check.faint and doubtful == 0.0:
            clear.append(check)
        doubtful = doubtful_after(doubtful, bool(check.faint), 1.0)
    return tuple(clear)


def bound(places: PlaceChecks, stay_checks: int, places_per_h: float, alarms: Alarms) -> Bound | None:
    """The bound for a vehicle that stays `stay_checks` checks at each place and meets `places_per_h` places an hour;
    None with fewer than `MIN_PLACES` places."""
    if len(places.checks) < MIN_PLACES:
        return None
    accused = [_accused(places, far, stay_checks, alarms) for far in DISPLACEMENTS]
    # A farther place is never less likely to accuse: a smaller share is chance.
    share = np.maximum.accumulate(np.array(accused))
    weight, beyond = tail(places.displacement, np.array(DISPLACEMENTS))
    rates = 100.0 * places_per_h * np.sum(np.diff(share, prepend=0.0) * beyond, axis=1)
    order = np.argsort(rates, kind="stable")
    place = int(np.searchsorted(np.cumsum(weight[order]), BOUND_CONFIDENCE))
    half = next((far for far, part in zip(DISPLACEMENTS, share, strict=True) if part >= 0.5), None)
    return Bound(float(np.sum(weight * rates)), float(rates[order][min(place, len(rates) - 1)]), half)


def tail(seen: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tails fitted to the displacements `seen` (n,), generalised Pareto beyond their median: the weight of each tail
    (k,), its likelihood scaled to a sum of 1, and the share of places (k, m) that it has beyond `at` (m,)."""
    threshold = float(np.median(seen))
    excess = seen[seen > threshold] - threshold
    mean = float(excess.mean())
    likelihood, shares = [], []
    for shape in TAIL_SHAPES.tolist():
        for scale in (TAIL_SCALES * mean).tolist():
            likelihood.append(float(np.sum(_log_density(excess, shape, scale))))
            shares.append(len(excess) / len(seen) * _survival(np.maximum(at - threshold, 0.0), shape, scale))
    weight = np.exp(np.array(likelihood) - max(likelihood))
    return weight / weight.sum(), np.array(shares)


def _log_density(excess: NDArray[np.float64], shape: float, scale: float) -> NDArray[np.float64]:
    if abs(shape) < 1e-9:
        return np.asarray(-log(scale) - excess / scale)
    inside = 1.0 + shape * excess / scale
    with np.errstate(divide="ignore", invalid="ignore"):
        density = -log(scale) - (1.0 + 1.0 / shape) * np.log(inside)
    return np.where(inside > 0.0, density, -np.inf)


def _survival(excess: NDArray[np.float64], shape: float, scale: float) -> NDArray[np.float64]:
    if abs(shape) < 1e-9:
        return np.asarray(np.exp(-excess / scale))
    return np.asarray(np.maximum(1.0 + shape * excess / scale, 0.0) ** (-1.0 / shape))


def _accused(places: PlaceChecks, displacement: float, stay_checks: int, alarms: Alarms) -> float:
    """The share of drawn places of one displacement at which the mount is accused."""
    rng = np.random.default_rng([PLACE_SEED, round(100.0 * displacement), stay_checks])
    return float(np.mean([alarms(_stay(places, displacement, stay_checks, rng)) for _ in range(DRAWS)]))


def _stay(places: PlaceChecks, displacement: float, stay_checks: int, rng: np.random.Generator) -> list[Judged]:
    """Checks of a right mount, followed by checks of a place that is off about or along one axis."""
    checks = places.checks[int(rng.integers(len(places.checks)))]
    offsets = _offsets(checks)
    # A few checks scatter less about their own centre than about the true displacement of their place.
    about = (offsets - _centre(checks)) * np.sqrt(len(checks) / (len(checks) - 1.0))
    off = np.zeros(6)
    axis = int(rng.integers(6))
    off[axis] = displacement * _place_sigma(checks)[axis] * float(rng.choice([-1.0, 1.0]))
    sampled = rng.integers(len(checks), size=SETTLED_BEFORE_PLACE + stay_checks)
    return [
        checks[one].model_copy(update={"offset": tuple((about[one] + off * (number >= SETTLED_BEFORE_PLACE)).tolist())})
        for number, one in enumerate(sampled.tolist())
    ]


def _place_sigma(checks: Sequence[Judged]) -> NDArray[np.float64]:
    """(6,) the standard deviation of a place, given the dispersions of its checks."""
    return np.asarray(np.mean([np.array(check.place) * check.dispersion for check in checks], axis=0))


def _centre(checks: Sequence[Judged]) -> NDArray[np.float64]:
    """(6,) median offset of the checks of a place, so that an outlier does not count."""
    return np.asarray(np.median(_offsets(checks), axis=0))


def _offsets(checks: Sequence[Judged]) -> NDArray[np.float64]:
    return np.array([check.offset for check in checks])
