"""How likely the offset of a check is: where the mount is right, and where it has moved to a place.

A check is one of two things. A good one lies about the mount, Student-distributed: most within its own uncertainty,
some a few times as far. A bad one (a tunnel, an open road, a frame that a lorry fills) lies anywhere within reach, or
once more where the one before it lay, as long as the scene stays the same. So no single check can be worth more than
the rarity of bad ones, and checks that contradict each other are worth nothing.

Rotations and translations are told apart, three axes each. Plain floats: what is decided has to replay to the byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, fsum, lgamma, log, pi

FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of good checks: heavier tails than the normal one. Chosen; of 261
coordinates of good checks on three simulated drives one was farther than four standard deviations, here 4 would be."""

BAD_SHARE, BAD_AFTER_BAD, BAD_SHARE_WEAK = 0.01, 0.5, 0.8
"""Share of checks that are bad though no cause was found in their data: after a good one, after a bad one, and of those
with faint edges. Chosen to be on the safe side of a drive: none of 87 checks of simulated drives without poor stretches
was bad; within tunnels, open roads and nights 14 of 56 with clear edges and some 57 of 63 with faint ones."""

SAME_AGAIN, SAME_AGAIN_WEAK = 0.03, 0.2
"""Share of bad checks that lie where the one before lay, with clear and with faint edges. Chosen: with clear edges none
was seen to. Less makes three checks certain sooner, more lets a scene that stays the same accuse later."""

FARTHER = 0.03
"""Of its offset, by which a check is less certain: far from the pose the local optimum is found less exactly."""

WEAK_TIMES = 10.0
"""Times the standard deviation of others that a check with faint edges has: by night on simulated drives the best of
them, 6 of 63, lie 0.3 to 0.7° off the mount."""

AXES = 3
"""Of rotation, and of translation."""

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Told:
    """What one check tells of three axes (rad or m).

    Attributes:
        offset: from the pose that is served.
        noise: variance that is new at every check.
        place: variance that neighbouring checks share and other places do not.
        rig: variance of what no place tells: the estimator's bias on this rig, as far as it is unknown.
        before: the offset of the check before, if there was one.
        weak: whether its edges are faint.
    """

    offset: Three
    noise: Three
    place: Three
    rig: Three
    before: Three | None
    weak: bool


@dataclass(frozen=True, slots=True)
class Belief:
    """Where the mount is, as far as is known: mean and variance per axis (rad or m, and squared); and how far the last
    check was a bad one there, 0 to 1."""

    mean: Three
    variance: Three
    astray: float = 0.0

    def after(self, told: Told, scored: Scored, share: float) -> Belief:
        """The belief after a check that scored so under it, and counts by `share`, 0 to 1."""
        # The farther out a good check lies, the less it weighs (the weight of the Student distribution, at most 1).
        weight = share * scored.good * min((FREEDOM + AXES) / (FREEDOM + self.distance2(told)), 1.0)
        precision = [1.0 / v + weight / n for v, n in zip(self.variance, told.noise, strict=True)]
        variance = [1.0 / p for p in precision]
        rows = zip(self.mean, told.offset, variance, told.noise, strict=True)
        mean = [m + v * weight / n * (y - m) for m, y, v, n in rows]
        return Belief(three(mean), three(variance), 1.0 - scored.good)

    def wider(self, variance: Three) -> Belief:
        """One that knows so much less."""
        return Belief(self.mean, plus(self.variance, variance), self.astray)

    def distance2(self, told: Told) -> float:
        """Squared distance of a check from it in standard deviations."""
        rows = zip(told.offset, self.mean, self.variance, told.noise, strict=True)
        return fsum((y - m) ** 2 / (v + n) for y, m, v, n in rows)


def three(values: Sequence[float]) -> Three:
    """Of three values."""
    x, y, z = values
    return float(x), float(y), float(z)


def plus(one: Three, other: Three) -> Three:
    """Axis by axis."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


_CONSTANT = lgamma((FREEDOM + AXES) / 2.0) - lgamma(FREEDOM / 2.0) - AXES / 2.0 * log(FREEDOM * pi)


def log_density(offset: Three, mean: Three, variance: Three) -> float:
    """Of the multivariate Student distribution with independent scales, nats per rad³ or m³."""
    q = sum((y - m) ** 2 / v for y, m, v in zip(offset, mean, variance, strict=True))
    spread = log(variance[0] * variance[1] * variance[2])
    return _CONSTANT - 0.5 * spread - 0.5 * (FREEDOM + AXES) * log(1.0 + q / FREEDOM)


@dataclass(frozen=True, slots=True)
class Scored:
    """A check under a belief: its log density, and how far it is a good one of this mount, 0 to 1."""

    log_density: float
    good: float


def score(told: Told, belief: Belief, reach: Three) -> Scored:
    """A check where the mount is as believed. `reach`: standard deviations of bad checks, per axis."""
    bad = BAD_SHARE_WEAK if told.weak else BAD_SHARE + belief.astray * (BAD_AFTER_BAD - BAD_SHARE)
    good = log(1.0 - bad) + log_density(told.offset, belief.mean, plus(belief.variance, told.noise))
    astray = log(bad) + _log_density_of_bad(told, reach)
    most = max(good, astray)
    total = most + log(exp(good - most) + exp(astray - most))
    return Scored(total, exp(good - total))


def _log_density_of_bad(told: Told, reach: Three) -> float:
    again = SAME_AGAIN_WEAK if told.weak else SAME_AGAIN
    anywhere = log_density(told.offset, (0.0, 0.0, 0.0), three([r * r for r in reach]))
    if told.before is None:
        return anywhere
    elsewhere = log(1.0 - again) + anywhere
    same = log(again) + log_density(told.offset, told.before, plus(told.noise, told.noise))
    most = max(elsewhere, same)
    return most + log(exp(elsewhere - most) + exp(same - most))
