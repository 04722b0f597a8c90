"""Does the mount move from one check to the next? A test of scatter beside the test of a step.

A loose mount swings about some pose. No check can say where it is, because it is elsewhere at the next, and a test of a
step finds no place to which it moved. What shows is that neighbouring checks lie farther apart than their noise allows:
the successive differences of von Neumann (1941). They cancel what neighbouring checks share, which is the bias of the
rig and most of the error of a street. For every axis of rotation the evidence is a cumulative sum of log-likelihood
ratios (Page 1954) of differences widened by a swing against those of a mount at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, fsum, log, radians

from coec.calibration.monitor.likelihood import BAD_SHARE, FREEDOM, CheckMeasurement, Three, plus, three

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
