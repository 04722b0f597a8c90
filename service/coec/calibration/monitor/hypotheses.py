"""Has the mount moved, when, and to where? The question is asked for three axes at a time, again at every check.

After Page (1954) and Lorden (1971): every check begins a test of "it moved just now" against "it did not", which goes
on for ever or ends by accusing. The new place is unknown, so each test learns it as it goes, and predicts every check
from those before it (Lorden and Pollak 2005, nonanticipating estimation). Under a right mount the likelihood ratio of
such a test is a martingale, so it reaches e^h in a share of at most e^-h of the tests (Ville). By Lorden's theorem the
mean run between false accusations is then at least e^h checks: the threshold is the logarithm of a number of checks.

A right mount is not a point: in every street the optimum lies a little elsewhere, at all neighbouring checks alike.
Both sides of a test learn where it lies; on the side without a move it may be off by no more than streets differ. So
what streets do is no evidence, however long it lasts.

Both sides take a test's checks for those of one street. When the vehicle comes to the next one both have to follow, and
the side with a move does so faster. By that alone a test could gain evidence for a move to where the mount has always
been. In the end both explain the checks alike, and what is left for a move is how much likelier its place was
beforehand than as a place of a right mount (the ratio of Savage and Dickey, Dickey 1971). No test keeps more than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import fsum, log

from coec.calibration.monitor.likelihood import CheckMeasurement, OffsetPosterior, Three, plus, score, three

LEAST_STEP, MOST_STEP = -5.0, 6.0
"""Most nats by which one check may speak against a test, and for it: no check decides alone, and three acquit."""

PLACE_TIMES = 1.5
"""Factor on the standard deviation of places for the place where a right mount is: a move is what no place explains,
and of thousands of places in a hundred hours the farthest counts. Chosen between 1, with which most places four
standard deviations off accuse, and 2, with which it takes half a minute to tell a move of a degree from a place. Places
of simulated drives were within 1.3 standard deviations in 95 of 100."""

SCATTER = 0.7
"""Standard deviation of the places of a right mount, in standard deviations of `place`. On the axis on which 111 places
of simulated drives scatter most their rms is 0.6."""

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
