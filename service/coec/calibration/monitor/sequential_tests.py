"""Sequential tests over checks: the likelihood of the offset of a check if the mount is right and if it has moved,
tests for a step at some past check to some place, and a test for scatter from one check to the next. Rotations and
translations are tested separately, three axes each. Plain floats: decisions have to replay to the byte.

A check is good or bad. A good check lies about the mount, Student-distributed: mostly within its own uncertainty,
sometimes a few times as far. A bad check (a tunnel, an open road, a frame that a lorry fills) lies anywhere within
reach, or again where the check before it lay if the scene is still the same. So a single check is worth no more than
the rarity of bad ones, and checks that contradict each other are worth nothing.

After Page (1954) and Lorden (1971): every check begins a test of "it moved just now" against "it did not", which goes
on for ever or ends with an alarm. The new place is unknown, so each test learns it as it goes, and predicts every check
from those before it (Lorden and Pollak 2005, nonanticipating estimation). Under a right mount the likelihood ratio of
such a test is a martingale, so it reaches e^h in a share of at most e^-h of the tests (Ville). By Lorden's theorem the
mean run between false alarms is then at least e^h checks: the threshold is the logarithm of a number of checks.

A right mount is not a point: in every street the optimum lies a little elsewhere, at all neighbouring checks alike.
Both sides of a test learn where it lies; on the side without a move it may be off by no more than streets differ. So
what streets do is no evidence, however long it lasts.

Both sides take a test's checks for those of one street. When the vehicle comes to the next one both have to follow, and
the side with a move does so faster. By that alone a test could gain evidence for a move to where the mount has always
been. In the end both explain the checks alike, and what is left for a move is how much likelier its place was
beforehand than as a place of a right mount (the ratio of Savage and Dickey, Dickey 1971). No test keeps more than that.

A loose mount swings about some pose. No check can say where it is, because it is elsewhere at the next, and a test of a
step finds no place to which it moved. What shows is that neighbouring checks lie farther apart than their noise allows:
the successive differences of von Neumann (1941). They cancel what neighbouring checks share, which is the bias of the
rig and most of the error of a street. For every axis of rotation the evidence is a cumulative sum of log-likelihood
ratios (Page 1954) of differences widened by a swing against those of a mount at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, fsum, lgamma, log, pi, radians

FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of good checks: its tails are heavier than normal. See
docs/measured.md."""

BAD_SHARE, BAD_AFTER_BAD, BAD_SHARE_WEAK = 0.01, 0.5, 0.8
"""Share of checks that are bad although no cause was found in their data: after a good check, after a bad one, and of
checks with faint edges. See docs/measured.md."""

SAME_AGAIN, SAME_AGAIN_WEAK = 0.03, 0.2
"""Share of bad checks that lie where the check before them lay, with clear and with faint edges. A smaller share makes
three checks certain sooner; with a larger one a scene that stays the same accuses later. See docs/measured.md."""

FARTHER = 0.03
"""Share of its offset by which a check is less certain: far from the pose the local optimum is found less exactly."""

WEAK_TIMES = 10.0
"""Factor on the standard deviation of a check with faint edges. See docs/measured.md."""

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


LEAST_STEP, MOST_STEP = -5.0, 6.0
"""Most nats by which one check may speak against a test, and for it: no check decides alone, and three acquit."""

PLACE_TIMES = 1.5
"""Factor on the standard deviation of places for the place where a right mount is: a move is what no place explains,
and of thousands of places in a hundred hours the farthest counts. See docs/measured.md."""

SCATTER = 0.7
"""Standard deviation of the places of a right mount, in standard deviations of `place`. See docs/measured.md."""

STAY = 120.0
"""Checks at one place, at most: ten minutes at one every five seconds. Longer tests have seen several places, and the
mean of n places scatters by a factor of √n less."""

THINNING = 2.0
"""Ratio of the ages of neighbouring tests: older tests are sparser, because the exact time of a move matters less."""

OLDEST = 8192
"""Checks after which a test ends: eleven hours at one every five seconds."""


@dataclass(frozen=True, slots=True)
class TestedAxes:
    """Three axes that are tested together.

    Attributes:
        reach: standard deviation of the offset of a bad check, per axis (rad or m).
        moves: standard deviations of the moves that are looked for: small ones and large ones.
    """

    reach: Three
    moves: tuple[Three, ...]


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """ "It moved just before `age` checks."

    Attributes:
        kind: index of the move in `Axes.moves`.
        age: number of checks since, partial ones by their part.
        evidence: log-likelihood ratio, nats.
        moved, right: where the mount is if it moved, and if it did not.
        rig: where a right mount was thought to be when the test began, wherever the vehicle is.
    """

    kind: int
    age: float
    evidence: float
    moved: OffsetPosterior
    right: OffsetPosterior
    rig: OffsetPosterior


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """All running tests over three axes, the youngest first; where a right mount has been so far; and the offset of the
    last check."""

    right: OffsetPosterior | None = None
    running: tuple[Hypothesis, ...] = ()
    before: Three | None = None

    @property
    def leading(self) -> Hypothesis | None:
        """The test with the most evidence; of equals the oldest."""
        return max(reversed(self.running), key=lambda test: test.evidence, default=None)


def after_check(
    tests: Hypotheses, measurement: CheckMeasurement, axes: TestedAxes, share: float, most: float
) -> Hypotheses:
    """The tests after one more check that counts by `share`, 0 to 1. The check raises no test above the evidence
    `most`; a test that is above it already keeps its evidence."""
    right = tests.right if tests.right is not None else OffsetPosterior((0.0, 0.0, 0.0), measurement.rig)
    started = [_started(kind, right, measurement, axes) for kind in range(len(axes.moves))]
    running = [_continued(test, measurement, axes, share, most) for test in (*started, *tests.running)]
    scored = score(measurement, right.wider(_farthest(measurement.place)), axes.reach)
    # Neighbouring checks share the error of their street: about the rig they say no more than one street can.
    of_rig = plus(measurement.noise, measurement.place)
    # Faint checks of one place are all off alike, however many there are: nothing is learnt of the rig from them.
    learnt = right if measurement.weak else right.after(replace(measurement, noise=of_rig), scored, share)
    least = three([max(v, n / OLDEST) for v, n in zip(learnt.variance, of_rig, strict=True)])
    learnt = replace(learnt, variance=least)
    return Hypotheses(learnt, _thinned(running), measurement.offset)


def learnt_distance2(tests: Hypotheses, rig: Three) -> float:
    """How far beside the served pose the checks have put the mount, in standard deviations, squared. The mean that is
    learnt has variance `rig` (per axis) less the variance v that is left, so the distance of a right mount is χ²
    distributed unless something else moves it."""
    if tests.right is None:
        return 0.0
    rows = zip(tests.right.mean, tests.right.variance, rig, strict=True)
    return fsum(m * m / (r - v) for m, v, r in rows if r > v)


def _started(kind: int, right: OffsetPosterior, measurement: CheckMeasurement, axes: TestedAxes) -> Hypothesis:
    street = right.wider(_farthest(measurement.place))
    moves = three([sigma * sigma for sigma in axes.moves[kind]])
    return Hypothesis(kind, 0.0, 0.0, street.wider(moves), street, right)


def _farthest(place: Three) -> Three:
    """Variance of where a place may put a right mount, from the variance of places."""
    return three([PLACE_TIMES**2 * variance for variance in place])


def _continued(
    test: Hypothesis, measurement: CheckMeasurement, axes: TestedAxes, share: float, most: float
) -> Hypothesis:
    of_move, of_right = (score(measurement, posterior, axes.reach) for posterior in (test.moved, test.right))
    step = min(max(of_move.log_density - of_right.log_density, LEAST_STEP), MOST_STEP)
    evidence = test.evidence + share * step
    if step > 0.0:
        evidence = min(evidence, max(most, test.evidence))
    age, moved = test.age + share, test.moved.after(measurement, of_move, share)
    log_prior_odds = _log_prior_odds(moved, test.rig.wider(_scatter(measurement.street, age)), axes.moves[test.kind])
    # Not below 0: a test that began before the mount moved would be too far behind to tell a small move.
    evidence = min(evidence, max(log_prior_odds, 0.0))
    return Hypothesis(test.kind, age, evidence, moved, test.right.after(measurement, of_right, share), test.rig)


def _scatter(street: Three, age: float) -> Three:
    """Variance of where a right mount seems to be on average over `age` checks, from the variance of streets: a check
    in a poor scene does not take from the evidence of better ones."""
    return three([SCATTER**2 * variance * min(STAY / age, 1.0) for variance in street])


def _log_prior_odds(moved: OffsetPosterior, right: OffsetPosterior, move: Three) -> float:
    """How much likelier a mount at the mean of `moved` was beforehand as one that moved than as a right one, nats.
    `move`: standard deviations of a move."""
    rows = zip(moved.mean, right.mean, right.variance, move, strict=True)
    return 0.5 * fsum((m - r) ** 2 * (1.0 / v - 1.0 / (v + s * s)) - log(1.0 + s * s / v) for m, r, v, s in rows)


def _thinned(running: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """The tests to keep: for every kind of move those at ages that grow by a factor, and always the leading one."""
    retained: list[Hypothesis] = []
    for kind in sorted({test.kind for test in running}):
        of_kind = [test for test in running if test.kind == kind and test.age <= OLDEST]
        leading = max(reversed(of_kind), key=lambda test: test.evidence)
        sparse: list[Hypothesis] = []
        for place, test in enumerate(of_kind):
            older = of_kind[place + 1].age if place + 1 < len(of_kind) else None
            # Without this test the next one would still be near enough in age to the last that was kept.
            crowded = sparse and older is not None and older <= THINNING * sparse[-1].age
            if test is leading or not crowded:
                sparse.append(test)
        retained += sparse
    return tuple(retained)


SWING_RAD = radians(0.3)
"""Standard deviation of the pose of a loose mount that is looked for."""

LOOSE_AT = 10.0
"""Evidence, nats, from which a mount is loose. At a check every five seconds a mount at rest reaches it on one of three
axes once in ten hours at most, by the logarithm of the number of checks, as the other levels do."""

LEAST_SCATTER_STEP, MOST_SCATTER_STEP, MOST = -2.0, 3.0, 13.0
"""Bounds of one difference, and of the sum, nats: no pair of bad checks decides, and a mount that was tightened is
forgotten after three or four checks."""


@dataclass(frozen=True, slots=True)
class MountScatter:
    """What the differences between neighbouring checks add up to.

    Attributes:
        of_axes: log-likelihood ratio per axis of rotation, nats, at least 0.
        before, variance: offset of the last check with clear edges (rad), and variance of its noise and place; None
            before the first.
    """

    of_axes: Three = (0.0, 0.0, 0.0)
    before: Three | None = None
    variance: Three | None = None

    @property
    def evidence(self) -> float:
        """The evidence on the axis that scatters most, nats."""
        return max(self.of_axes)

    def distance2(self, measured: CheckMeasurement) -> float:
        """Squared distance between a check and the last one with clear edges, in standard deviations of a mount at
        rest; 0 before the first."""
        if self.before is None or self.variance is None:
            return 0.0
        at_rest = plus(plus(measured.noise, measured.place), self.variance)
        rows = zip(measured.offset, self.before, at_rest, strict=True)
        return fsum((one - other) ** 2 / variance for one, other, variance in rows)

    def after(self, measured: CheckMeasurement | None, reach: Three, share: float) -> MountScatter:
        """The sum after one more check that counts by `share`, 0 to 1. `measured` is what the check says of the
        rotations, None if it does not determine them; `reach` are the standard deviations of bad checks (rad). A check
        with faint edges says nothing of scatter."""
        if measured is None or measured.weak:
            return self
        variance = plus(measured.noise, measured.place)
        if self.before is None or self.variance is None:
            return MountScatter(self.of_axes, measured.offset, variance)
        rows = zip(self.of_axes, measured.offset, self.before, plus(variance, self.variance), reach, strict=True)
        sums = [sum_ + share * _step(one - other, at_rest, far) for sum_, one, other, at_rest, far in rows]
        return MountScatter(three([min(max(value, 0.0), MOST) for value in sums]), measured.offset, variance)


def _step(difference: float, at_rest: float, reach: float) -> float:
    """Log-likelihood ratio of a difference (rad) whose variance is `at_rest` if the mount does not move. Either of the
    two checks may be a bad one, whose standard deviation is `reach`."""
    loose, still = (_log_density(difference, variance, reach) for variance in (at_rest + 2.0 * SWING_RAD**2, at_rest))
    return min(max(loose - still, LEAST_SCATTER_STEP), MOST_SCATTER_STEP)


def _log_density(difference: float, variance: float, reach: float) -> float:
    """Up to the same constant for every variance."""
    bad = 2.0 * BAD_SHARE
    good, astray = log(1.0 - bad) + _student(difference, variance), log(bad) + _student(difference, reach * reach)
    most = max(good, astray)
    return most + log(exp(good - most) + exp(astray - most))


def _student(difference: float, variance: float) -> float:
    return -0.5 * log(variance) - 0.5 * (FREEDOM + 1.0) * log(1.0 + difference * difference / variance / FREEDOM)
