"""Has the mount moved, when, and to where? The question is asked for three axes at a time, again at every check.

After Page (1954) and Lorden (1971): every check begins a test of "it moved just now" against "it did not", which goes
on for ever or ends by accusing. The new place is unknown, so each test learns it as it goes, and predicts every check
from those before it (Lorden and Pollak 2005, nonanticipating estimation). Under a right mount the likelihood ratio of
such a test is a martingale, so it reaches e^h in a share of at most e^-h of the tests (Ville). By Lorden's theorem the
mean run between false accusations is then at least e^h checks: the threshold is the logarithm of a number of checks.

A right mount is not a point: in every street the optimum lies a little elsewhere, at all neighbouring checks alike.
Both sides of a test learn where it lies; on the side without a move it may be off by no more than streets differ. So
what streets do is no evidence, however long it lasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import fsum

from coec.calibration.monitor.likelihood import Belief, Three, Told, plus, score, three

LEAST_STEP, MOST_STEP = -5.0, 6.0
"""Most nats by which one check may speak against a test, and for it: no check decides alone, and three acquit."""

PLACE_TIMES = 1.5
"""Factor on the standard deviation of places for the place where a right mount is: a move is what no place explains,
and of thousands of places in a hundred hours the farthest counts. Chosen between 1, with which most places four
standard deviations off accuse, and 2, with which it takes half a minute to tell a move of a degree from a place. Places
of simulated drives were within 1.3 standard deviations in 95 of 100."""

THINNING = 2.0
"""Ratio of the ages of neighbouring tests: older tests are sparser, because the exact time of a move matters less."""

OLDEST = 8192
"""Checks after which a test ends: eleven hours at one every five seconds."""


@dataclass(frozen=True, slots=True)
class Axes:
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
    """

    kind: int
    age: float
    evidence: float
    moved: Belief
    right: Belief


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """All running tests over three axes, the youngest first; where a right mount has been so far; and the offset of the
    last check."""

    right: Belief | None = None
    running: tuple[Hypothesis, ...] = ()
    before: Three | None = None

    @property
    def leading(self) -> Hypothesis | None:
        """The test with the most evidence; of equals the oldest."""
        return max(reversed(self.running), key=lambda test: test.evidence, default=None)


def after_check(tests: Hypotheses, told: Told, axes: Axes, share: float, most: float) -> Hypotheses:
    """The tests after one more check that counts by `share`, 0 to 1. The check raises no test above the evidence
    `most`; a test that is above it already keeps its evidence."""
    right = tests.right if tests.right is not None else Belief((0.0, 0.0, 0.0), told.rig)
    begun = [_begun(kind, right, told, axes) for kind in range(len(axes.moves))]
    running = [_continued(test, told, axes, share, most) for test in (*begun, *tests.running)]
    scored = score(told, right.wider(_farthest(told.place)), axes.reach)
    # Neighbouring checks share the error of their street: about the rig they say no more than one street can.
    of_rig = plus(told.noise, told.place)
    # Faint checks of one place are all off alike, however many there are: nothing is learnt of the rig from them.
    learnt = right if told.weak else right.after(replace(told, noise=of_rig), scored, share)
    least = three([max(v, n / OLDEST) for v, n in zip(learnt.variance, of_rig, strict=True)])
    learnt = replace(learnt, variance=least)
    return Hypotheses(learnt, _thinned(running), told.offset)


def learnt_distance2(tests: Hypotheses, rig: Three) -> float:
    """How far beside the served pose the checks have put the mount, in standard deviations, squared. The mean that is
    learnt has variance `rig` (per axis) less the variance v that is left, so the distance of a right mount is χ²
    distributed unless something else moves it."""
    if tests.right is None:
        return 0.0
    rows = zip(tests.right.mean, tests.right.variance, rig, strict=True)
    return fsum(m * m / (r - v) for m, v, r in rows if r > v)


def _begun(kind: int, right: Belief, told: Told, axes: Axes) -> Hypothesis:
    street = right.wider(_farthest(told.place))
    moves = three([sigma * sigma for sigma in axes.moves[kind]])
    return Hypothesis(kind, 0.0, 0.0, street.wider(moves), street)


def _farthest(place: Three) -> Three:
    """Variance of where a place may put a right mount, from the variance of places."""
    return three([PLACE_TIMES**2 * variance for variance in place])


def _continued(test: Hypothesis, told: Told, axes: Axes, share: float, most: float) -> Hypothesis:
    moved, right = (score(told, belief, axes.reach) for belief in (test.moved, test.right))
    step = min(max(moved.log_density - right.log_density, LEAST_STEP), MOST_STEP)
    evidence = test.evidence + share * step
    if step > 0.0:
        evidence = min(evidence, max(most, test.evidence))
    return Hypothesis(
        test.kind,
        test.age + share,
        evidence,
        test.moved.after(told, moved, share),
        test.right.after(told, right, share),
    )


def _thinned(running: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """The tests to keep: for every kind of move those at ages that grow by a factor, and always the leading one."""
    kept: list[Hypothesis] = []
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
        kept += sparse
    return tuple(kept)
