"""Does the mount move from one check to the next? A test of scatter beside the test of a step.

A loose mount swings about some pose. No check can say where it is, because it is elsewhere at the next, and a test of a
step finds no place to which it moved. What shows is that neighbouring checks lie farther apart than their noise allows:
the successive differences of von Neumann (1941). They cancel what neighbouring checks share, which is the bias of the
rig and most of the error of a street. The evidence is a cumulative sum of log-likelihood ratios (Page 1954) of
differences widened by a swing against those of a mount at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, radians

from coec.calibration.monitor.likelihood import (
    BAD_SHARE,
    Three,
    Told,
    log_density,
    plus,
    three,
)

SWING_RAD = radians(0.3)
"""Standard deviation of the pose of a loose mount that is looked for, per axis."""

LOOSE_AT = 9.0
"""Evidence, nats, from which a mount is loose: at a check every five seconds a mount at rest reaches it once in eleven
hours at most, by the logarithm of the number of checks, as the other levels do."""

LEAST_STEP, MOST_STEP, MOST = -2.0, 3.0, 12.0
"""Bounds of one difference, and of the sum, nats: no pair of bad checks decides, and a mount that was tightened is
forgotten after three or four checks."""


@dataclass(frozen=True, slots=True)
class MountScatter:
    """What the differences between neighbouring checks add up to.

    Attributes:
        evidence: log-likelihood ratio, nats, at least 0.
        before, variance: offset of the last check with clear edges (rad), and variance of its noise and place; None
            before the first.
    """

    evidence: float = 0.0
    before: Three | None = None
    variance: Three | None = None

    def after(self, told: Told | None, reach: Three, share: float) -> MountScatter:
        """The sum after one more check that counts by `share`, 0 to 1. `told` is what the check says of the rotations,
        None if it does not determine them; `reach` are the standard deviations of bad checks (rad). A check with faint
        edges says nothing of scatter."""
        if told is None or told.weak:
            return self
        variance = plus(told.noise, told.place)
        if self.before is None or self.variance is None:
            return MountScatter(self.evidence, told.offset, variance)
        apart = three([a - b for a, b in zip(told.offset, self.before, strict=True)])
        at_rest = plus(variance, self.variance)
        step = _log_density(apart, plus(at_rest, (2.0 * SWING_RAD**2,) * 3), reach) - _log_density(
            apart, at_rest, reach
        )
        evidence = self.evidence + share * min(max(step, LEAST_STEP), MOST_STEP)
        return MountScatter(min(max(evidence, 0.0), MOST), told.offset, variance)


def _log_density(apart: Three, variance: Three, reach: Three) -> float:
    """Of a difference of two checks, each of which may be a bad one."""
    bad = 2.0 * BAD_SHARE
    good = log(1.0 - bad) + log_density(apart, (0.0, 0.0, 0.0), variance)
    astray = log(bad) + log_density(apart, (0.0, 0.0, 0.0), three([r * r for r in reach]))
    most = max(good, astray)
    return most + log(exp(good - most) + exp(astray - most))
