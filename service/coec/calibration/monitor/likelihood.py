"""How likely the offset of a check is, if the mount is right and if it has moved to some place.

A check is good or bad. A good check lies about the mount, Student-distributed: mostly within its own uncertainty,
sometimes a few times as far. A bad check (a tunnel, an open road, a frame that a lorry fills) lies anywhere within
reach, or again where the check before it lay if the scene is still the same. So a single check is worth no more than
the rarity of bad ones, and checks that contradict each other are worth nothing.

Rotations and translations are treated separately, three axes each. Plain floats: decisions have to replay to the byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, fsum, lgamma, log, pi

FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of good checks: its tails are heavier than normal. Chosen: of 261
coordinates of good checks on three simulated drives one was farther off than four standard deviations; by this
distribution 4 would be."""

BAD_SHARE, BAD_AFTER_BAD, BAD_SHARE_WEAK = 0.01, 0.5, 0.8
"""Share of checks that are bad although no cause was found in their data: after a good check, after a bad one, and of
checks with faint edges. Chosen to be on the safe side: of 87 checks of simulated drives without poor stretches none was
bad; within tunnels, open roads and nights 14 of 56 with clear edges were, and some 57 of 63 with faint ones."""

SAME_AGAIN, SAME_AGAIN_WEAK = 0.03, 0.2
"""Share of bad checks that lie where the check before them lay, with clear and with faint edges. Chosen: with clear
edges none was seen to. A smaller share makes three checks certain sooner; with a larger one a scene that stays the same
accuses later."""

FARTHER = 0.03
"""Share of its offset by which a check is less certain: far from the pose the local optimum is found less exactly."""

WEAK_TIMES = 10.0
"""Factor on the standard deviation of a check with faint edges: by night on simulated drives the best of them, 6 of 63,
lie 0.3 to 0.7° off the mount."""

AXES = 3
"""Axes of rotation, and of translation."""

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CheckMeasurement:
    """What one check says about three axes (rad or m).

    Attributes:
        offset: from the served pose.
        noise: variance of the error that is new at every check.
        place: variance of the error that neighbouring checks share and checks elsewhere do not.
        street: that variance on a street, where checks tell more than in other scenes.
        rig: variance of the error that is the same everywhere: the unknown bias of the estimator on this rig.
        before: the offset of the check before, if there was one.
        weak: whether its edges are faint.
    """

    offset: Three
    noise: Three
    place: Three
    street: Three
    rig: Three
    before: Three | None
    weak: bool


@dataclass(frozen=True, slots=True)
class OffsetPosterior:
    """Where the mount is thought to be: mean and variance per axis (rad or m, and squared); and how far the last check
    was a bad one under this belief, 0 to 1."""

    mean: Three
    variance: Three
    astray: float = 0.0

    def after(self, measurement: CheckMeasurement, scored: Scored, share: float) -> OffsetPosterior:
        """The belief after a check that has the score `scored` under it and counts by `share`, 0 to 1."""
        # The farther out a good check lies, the less it weighs (the weight of the Student distribution, at most 1).
        weight = share * scored.good * min((FREEDOM + AXES) / (FREEDOM + self.distance2(measurement)), 1.0)
        precision = [1.0 / v + weight / n for v, n in zip(self.variance, measurement.noise, strict=True)]
        variance = [1.0 / p for p in precision]
        rows = zip(self.mean, measurement.offset, variance, measurement.noise, strict=True)
        mean = [m + v * weight / n * (y - m) for m, y, v, n in rows]
        return OffsetPosterior(three(mean), three(variance), 1.0 - scored.good)

    def wider(self, variance: Three) -> OffsetPosterior:
        """The belief with `variance` added to its own."""
        return OffsetPosterior(self.mean, plus(self.variance, variance), self.astray)

    def distance2(self, measurement: CheckMeasurement) -> float:
        """Squared distance of a check from the mean, in standard deviations."""
        rows = zip(measurement.offset, self.mean, self.variance, measurement.noise, strict=True)
        return fsum((y - m) ** 2 / (v + n) for y, m, v, n in rows)


def three(values: Sequence[float]) -> Three:
    """Three values as floats in a tuple."""
    x, y, z = values
    return float(x), float(y), float(z)


def plus(one: Three, other: Three) -> Three:
    """The sum, axis by axis."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


_CONSTANT = lgamma((FREEDOM + AXES) / 2.0) - lgamma(FREEDOM / 2.0) - AXES / 2.0 * log(FREEDOM * pi)


def log_density(offset: Three, mean: Three, variance: Three) -> float:
    """Log density of the multivariate Student distribution with independent scales, nats per rad³ or m³."""
    q = sum((y - m) ** 2 / v for y, m, v in zip(offset, mean, variance, strict=True))
    spread = log(variance[0] * variance[1] * variance[2])
    return _CONSTANT - 0.5 * spread - 0.5 * (FREEDOM + AXES) * log(1.0 + q / FREEDOM)


@dataclass(frozen=True, slots=True)
class Scored:
    """The score of a check under a belief: its log density, and how far it is a good check of this mount, 0 to 1."""

    log_density: float
    good: float


def score(measurement: CheckMeasurement, posterior: OffsetPosterior, reach: Three) -> Scored:
    """The score of a check if the mount is where it is believed. `reach`: standard deviations of bad checks, per
    axis."""
    bad = BAD_SHARE_WEAK if measurement.weak else BAD_SHARE + posterior.astray * (BAD_AFTER_BAD - BAD_SHARE)
    good = log(1.0 - bad) + log_density(measurement.offset, posterior.mean, plus(posterior.variance, measurement.noise))
    astray = log(bad) + _log_density_of_bad(measurement, reach)
    most = max(good, astray)
    total = most + log(exp(good - most) + exp(astray - most))
    return Scored(total, exp(good - total))


def _log_density_of_bad(measurement: CheckMeasurement, reach: Three) -> float:
    again = SAME_AGAIN_WEAK if measurement.weak else SAME_AGAIN
    anywhere = log_density(measurement.offset, (0.0, 0.0, 0.0), three([r * r for r in reach]))
    if measurement.before is None:
        return anywhere
    elsewhere = log(1.0 - again) + anywhere
    same = log(again) + log_density(measurement.offset, measurement.before, plus(measurement.noise, measurement.noise))
    most = max(elsewhere, same)
    return most + log(exp(elsewhere - most) + exp(same - most))
