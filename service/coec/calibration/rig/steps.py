"""What the looks at one edge say about a step at some time: where the edge was before, where it is since, and how well
that is known.

An accepted window tells a step by itself if what was served rests on windows, too: both have the bias of the one
estimator, which cancels, while the bias of checks is another and may be larger than a step.

Of the looks, each side is a robust mean. A good look is Student-distributed about the place of the edge; a bad look
lies anywhere within reach. This is the model of `monitor.likelihood`, in all six axes at once. The mean is the mode of
that mixture, found by expectation maximisation from several looks; the likeliest end is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.change_detector import ROTATIONS, TRANSLATIONS
from coec.calibration.monitor.likelihood import BAD_SHARE, FREEDOM
from coec.calibration.rig.evidence import BIAS_TIMES, MOST_SIGMA, EdgeObservation
from coec.calibration.types import Matrix4
from coec.geometry import dense, se3

Array = NDArray[np.float64]

MAX_OBSERVATIONS = 24
"""Looks of each edge that are kept one by one: two minutes at one every five seconds. Older ones are counted
together."""

MEMORY_OBSERVATIONS = 360.0
"""The older looks together count as this many at most: half an hour, so that the mean follows a mount that creeps."""

REACH = np.array([*ROTATIONS.reach, *TRANSLATIONS.reach])
"""(6,) standard deviation of the offsets of bad looks (rad, m)."""

MOST_WINDOWS = 4
"""Most windows of an edge that are kept: three may be urgent in one suspicion (`monitor.urgency`)."""

STARTS, TURNS = 3, 5
"""Looks from which a mean is sought, and rounds of the search: the means of drawn looks stand still after four."""

ExtraLikelihood = Callable[[Array, Array], Array]
"""Of offsets (T, S, 6) and their covariances (T, S, 6, 6), the log likelihood (T, S) of what else is known."""

_NOTHING = np.eye(6) / MOST_SIGMA**2
"""Information about a side of which nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeHistory:
    """The looks at one edge since its last state that was consistent.

    Attributes:
        origin: (4, 4) the pose from which offsets are counted.
        information, moment: (6, 6) and (6,) what is known of the offset from before the kept looks.
        looks: the kept looks in the order of their stamps, `MOST_LOOKS` at most.
        origin_sigma: (6,) standard deviation of the origin as windows see it; NaN on axes where that is not known.
        windows: the latest accepted windows, `MOST_WINDOWS` at most, if `origin_sigma` is known; else they are looks.
    """

    origin: Matrix4
    information: Array
    moment: Array
    observations: tuple[EdgeObservation, ...] = ()
    origin_sigma: Array = field(default_factory=lambda: np.full(6, np.nan))
    windows: tuple[EdgeObservation, ...] = ()

    @classmethod
    def at(cls, T_a_b: Matrix4, sigma: Array) -> EdgeHistory:
        """A history without looks: the edge is at T_a_b (4, 4), known to `sigma` (6,); NaN or zero where that is not
        known."""
        with np.errstate(invalid="ignore"):
            known = np.isfinite(sigma) & (sigma > 0.0) & (sigma < MOST_SIGMA)
        variance = np.where(known, np.where(known, sigma, 1.0) ** 2, MOST_SIGMA**2)
        return cls(T_a_b, np.diag(1.0 / variance), np.zeros(6))

    @classmethod
    def served(cls, T_a_b: Matrix4, sigma: Array) -> EdgeHistory:
        """A history without looks of an edge that serves T_a_b (4, 4), known to `sigma` (6,) without the bias of the
        estimator; NaN or zero where that is not known."""
        return replace(cls.at(T_a_b, sigma), origin_sigma=np.where(sigma > 0.0, sigma, np.nan))

    @property
    def all_observations(self) -> tuple[EdgeObservation, ...]:
        """All that is kept one by one, looks and windows, in the order of their stamps."""
        return tuple(sorted((*self.observations, *self.windows), key=lambda one: one.stamp_ns))

    def after(self, observation: EdgeObservation, calm: bool) -> EdgeHistory:
        """The history with one more look. The look that drops out is counted with the older ones if all is `calm`; else
        it is forgotten, because it may be from after the step in question."""
        if observation.window is not None and np.isfinite(self.step_covariance(observation.window).diagonal()).any():
            return replace(self, windows=(*self.windows, observation)[-MOST_WINDOWS:])
        if not self.observations:
            return replace(self._biased(BIAS_TIMES * observation.rig), observations=(observation,))
        observations = sorted((*self.observations, observation), key=lambda one: one.stamp_ns)
        if len(observations) <= MAX_OBSERVATIONS:
            return replace(self, observations=tuple(observations))
        oldest, recent = observations[0], replace(self, observations=tuple(observations[1:]))
        if not calm:
            return recent
        weight = _Stack.of(self.origin, [oldest]).weights(self.mean[None, None])[1][0, 0, 0]
        keep = 1.0 - 1.0 / MEMORY_OBSERVATIONS
        offset = se3.difference(oldest.T_a_b, self.origin)
        information = keep * self.information + weight * oldest.information
        moment = keep * self.moment + weight * dense.applied(oldest.information, offset)
        return replace(recent, information=information, moment=moment)

    @property
    def sigma(self) -> Array:
        """(6,) standard deviation of where the edge was before the kept looks; NaN where nothing is known."""
        variance = dense.inverse(self.information).diagonal()
        return np.sqrt(np.where(variance < 0.99 * MOST_SIGMA**2, variance, np.nan))

    @property
    def mean(self) -> Array:
        """(6,) the offset, by what is known from before the kept looks."""
        return np.asarray(dense.cholesky_solve(dense.cholesky(self.information), self.moment[:, None])[:, 0])

    @property
    def pose(self) -> Matrix4:
        """(4, 4) where the edge was before the kept looks."""
        return se3.perturb(self.origin, self.mean)

    def step_covariance(self, window: Array) -> Array:
        """(6, 6) covariance of the step from the origin to where a window is, given the covariance (6, 6) of the
        window; its diagonal is NaN on axes that either does not determine."""
        return np.asarray(window + np.diag(self.origin_sigma**2))

    def _biased(self, sigma: Array) -> EdgeHistory:
        """The origin as looks see it, which may all be biased by `sigma` (6,), however well it is known otherwise."""
        known = EdgeHistory.at(self.origin, np.hypot(np.nan_to_num(self.sigma), sigma))
        return replace(self, information=known.information, moment=known.moment)

    def counted(self) -> EdgeHistory:
        """The history with all kept looks counted together with the older ones, for a rig to which nothing happened."""
        if not self.observations:
            return self
        whole = _Stack.of(self.origin, self.observations).mean(
            np.ones((1, len(self.observations)), np.bool_), self.information, self.moment
        )
        return EdgeHistory.at(
            se3.perturb(self.origin, whole.offset[0]), np.sqrt(np.maximum(whole.covariance[0].diagonal(), 0.0))
        )


@dataclass(frozen=True, slots=True, eq=False)
class EdgeSteps:
    """The step of one edge, for each of T times at which it may have stepped.

    Attributes:
        xi: (T, 6) the step from where the edge was before to where it is since.
        covariance: (T, 6, 6) of that step.
        looks: (T,) number of good looks since.
        log_transient: (T,) logarithm of the chance that these are bad looks at one place instead.
        log_stepped: (T,) log likelihood of all looks, apart from the factor N(ξ; xi, covariance) of a step of ξ.
        log_still: log likelihood of all looks, bad ones among them, at one place.
    """

    xi: Array
    covariance: Array
    observations: Array
    log_transient: Array
    log_stepped: Array
    log_still: float


def steps_at(history: EdgeHistory, times_ns: Sequence[int], place_times: float = 1.0) -> EdgeSteps:
    """What the looks say of a step at each of some times: looks from that stamp on lie after the step. Places scatter
    the looks by `place_times` their usual standard deviation."""
    stamps, times = (
        np.array([observation.stamp_ns for observation in history.observations], np.int64),
        np.asarray(times_ns, np.int64),
    )
    after = stamps[None, :] >= times[:, None]
    stack = _Stack.of(history.origin, history.observations)
    windows = [_Window.of(window, history, times) for window in history.windows]
    place = np.max(
        np.array([observation.place for observation in history.observations]).reshape(-1, 6), axis=0, initial=0.0
    )
    places = np.diag(2.0 * (place_times * place) ** 2)  # one place before, one place since
    before = stack.mean(~after, history.information, history.moment)

    def log_likelihood_of_windows(offset: Array, covariance: Array) -> Array:
        """(T, S) log likelihood of all windows if the edge is at an offset (T, S, 6) since."""
        xi, around = offset - before.offset[:, None], covariance + (before.covariance + places)[:, None]
        return np.asarray(sum(window.log_best(xi, around) for window in windows))

    since = stack.mean(after, _NOTHING, np.zeros(6), log_likelihood_of_windows if windows else None)
    still = stack.mean(np.ones((1, len(history.observations)), np.bool_), history.information, history.moment)
    xi = np.zeros_like(before.offset)
    for t, (was, is_now) in enumerate(zip(before.offset, since.offset, strict=True)):
        xi[t] = se3.difference(se3.perturb(history.origin, is_now), se3.perturb(history.origin, was))
    covariance = before.covariance + since.covariance + places
    good = since.good
    observations = good.sum(axis=1)
    again = np.array([observation.log_bad_again for observation in history.observations])
    first = np.array([observation.log_bad for observation in history.observations]) - again
    # The first bad look is rarer than a bad one after it.
    log_transient = (good * again).sum(axis=1) + np.max(good, axis=1, initial=0.0) * np.max(first, initial=0.0)
    steps = EdgeSteps(
        xi,
        covariance,
        observations,
        np.minimum(log_transient, 0.0),
        before.log_evidence + since.log_evidence,
        float(still.log_evidence[0]),
    )
    for window in windows:
        steps = window.combined(steps)
    return steps


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """What an accepted window says of the step of its edge, whatever looks say. Like a look, it may be bad: it is if
    that is likelier, of a step within reach."""

    after: NDArray[np.bool_]  # (T,) whether it begins after the step
    axes: NDArray[np.int64]  # (n,) the axes of the step that it determines
    xi: Array  # (n,) the step on them, if it begins after the step
    covariance: Array  # (n, n) of it

    @classmethod
    def of(cls, window: EdgeObservation, history: EdgeHistory, times_ns: NDArray[np.int64]) -> _Window:
        assert window.window is not None
        covariance = history.step_covariance(window.window)
        axes = np.flatnonzero(np.isfinite(covariance.diagonal()))
        xi = se3.difference(window.T_a_b, history.origin)[axes]
        return cls(window.stamp_ns >= times_ns, axes, xi, covariance[np.ix_(axes, axes)])

    @property
    def log_bad(self) -> float:
        """Logarithm of the chance that it is bad, times the density of a bad one."""
        return log(BAD_SHARE) + float(_log_normal(np.diag(REACH[self.axes] ** 2), self.xi))

    @property
    def log_still(self) -> float:
        """Log likelihood of the window if there was no step before it."""
        return float(np.logaddexp(_LOG_GOOD + _log_normal(self.covariance, self.xi), self.log_bad))

    def log_best(self, xi: Array, covariance: Array) -> Array:
        """(T, ...) log likelihood, by the likelier of good and bad, beside a step ξ (T, ..., 6) that looks tell so well
        (T, ..., 6, 6)."""
        after = self.after.reshape(-1, *[1] * (xi.ndim - 2))
        return np.where(after, np.maximum(self._log_good(xi, covariance), self.log_bad), self.log_still)

    def _log_good(self, xi: Array, covariance: Array) -> Array:
        block, reach = covariance[..., self.axes[:, None], self.axes], np.diag(REACH[self.axes] ** 2)
        within = dense.product(reach, dense.inverse(block + reach))  # what looks tell, against the reach of a step
        difference = self.xi - dense.applied(within, xi[..., self.axes])
        return np.asarray(_LOG_GOOD + _log_normal(dense.product(within, block) + self.covariance, difference))

    def combined(self, steps: EdgeSteps) -> EdgeSteps:
        """The steps with what the window says of them."""
        block, difference = steps.covariance[:, self.axes[:, None], self.axes], self.xi - steps.xi[:, self.axes]
        fits = self.after & (self._log_good(steps.xi, steps.covariance) > self.log_bad)
        # Kalman's gain.
        gain = dense.product(steps.covariance[:, :, self.axes], dense.inverse(block + self.covariance))
        less = dense.product(gain, np.swapaxes(steps.covariance[:, :, self.axes], -1, -2))
        log_fit = np.where(fits, _LOG_GOOD + _log_normal(block + self.covariance, difference), self.log_bad)
        return replace(
            steps,
            xi=steps.xi + np.where(fits[:, None], dense.applied(gain, difference), 0.0),
            covariance=steps.covariance - np.where(fits[:, None, None], 0.5 * (less + np.swapaxes(less, -1, -2)), 0.0),
            observations=steps.observations + fits,
            # Looks that are bad for a while have to have a bad window beside them.
            log_transient=steps.log_transient + np.where(fits, log(BAD_SHARE), 0.0),
            log_stepped=steps.log_stepped + np.where(self.after, log_fit, self.log_still),
            log_still=steps.log_still + self.log_still,
        )


_LOG_GOOD = log(1.0 - BAD_SHARE)


def _log_normal(covariance: Array, x: Array) -> Array:
    """(...) logarithm of the density of a normal distribution about 0 with the covariance (..., n, n) at x (..., n)."""
    factor = dense.cholesky(covariance)
    q = np.sum(x * dense.cholesky_solve(factor, x[..., None])[..., 0], axis=-1)
    return np.asarray(-0.5 * (q + dense.log_determinant(factor) + x.shape[-1] * log(2.0 * pi)))


@dataclass(frozen=True, slots=True, eq=False)
class _Means:
    """Means of T selections of some looks: offset (T, 6), covariance (T, 6, 6), how far each look is a good one (T, N),
    and the log evidence (T,), which is the integral of their likelihood over the offset (Laplace)."""

    offset: Array
    covariance: Array
    good: Array
    log_evidence: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Some looks as arrays, offsets from one origin."""

    offset: Array  # (N, 6)
    information: Array  # (N, 6, 6)
    axes: Array  # (N,) number of axes determined
    log_good: Array  # (N,) logarithm of the peak density of a good look, times the share of good ones
    log_bad: Array  # (N,) logarithm of the density of a bad look at its offset, times the share of bad ones
    share: Array  # (N,) how much each look counts

    @classmethod
    def of(cls, origin: Matrix4, observations: Sequence[EdgeObservation]) -> _Stack:
        offset = np.array([se3.difference(observation.T_a_b, origin) for observation in observations]).reshape(-1, 6)
        information = np.array([observation.information for observation in observations]).reshape(-1, 6, 6)
        determined = np.array([observation.information.diagonal() > 0.0 for observation in observations]).reshape(-1, 6)
        axes = determined.sum(axis=1).astype(np.float64)
        whole = information + np.where(determined, 0.0, 1.0)[:, :, None] * np.eye(6)
        spread = dense.log_determinant(dense.cholesky(whole))
        bad = np.exp([observation.log_bad for observation in observations])
        constant = np.array([lgamma((FREEDOM + d) / 2.0) - lgamma(FREEDOM / 2.0) for d in axes.tolist()])
        log_good = np.log1p(-bad) + constant - 0.5 * axes * log(FREEDOM * pi) + 0.5 * spread
        within = np.where(determined, -0.5 * (offset / REACH) ** 2 - np.log(REACH) - 0.5 * log(2.0 * pi), 0.0)
        share = np.array([observation.share for observation in observations])
        return cls(offset, information, axes, log_good, np.log(bad) + within.sum(axis=1), share)

    def weights(self, mean: Array) -> tuple[Array, Array, Array]:
        """For each look about a mean (T, S, 6): its log density, its weight in the next mean, and how far it is a good
        one; each (T, S, N)."""
        away = self.offset - mean[:, :, None, :]
        q = dense.squared(self.information, away)
        log_good = self.log_good - 0.5 * (FREEDOM + self.axes) * np.log1p(q / FREEDOM)
        density = np.logaddexp(log_good, self.log_bad)
        good = self.share * np.exp(log_good - density)
        return self.share * density, good * np.minimum((FREEDOM + self.axes) / (FREEDOM + q), 1.0), good

    def mean(
        self, mask: NDArray[np.bool_], information: Array, moment: Array, extra: ExtraLikelihood | None = None
    ) -> _Means:
        """The means of the looks in each row of a mask (T, N), combined with what else is known. Of several, the one is
        taken that is likeliest by the looks and by what is known `beside` them."""
        known = dense.cholesky_solve(dense.cholesky(information), moment[:, None])[:, 0]
        if not len(self.offset):
            covariance = np.broadcast_to(dense.inverse(information), (len(mask), 6, 6))
            return _Means(
                np.broadcast_to(known, (len(mask), 6)), covariance, np.zeros((len(mask), 0)), _volume(covariance)
            )
        mean = np.stack([self._starts(row, known) for row in mask])
        for _ in range(TURNS):
            weight = self.weights(mean)[1] * mask[:, None, :]
            precision, moments = self._sums(weight, information, moment)
            mean = dense.cholesky_solve(dense.cholesky(precision), moments[..., None])[..., 0]
        density, weight, good = self.weights(mean)
        difference = mean - known
        likely = (density * mask[:, None, :]).sum(axis=-1) - 0.5 * dense.squared(information, difference)
        ranking = likely
        if extra is not None:
            precision, _ = self._sums(weight * mask[:, None, :], information, moment)
            ranking = likely + extra(mean, dense.inverse(precision))
        rows, best = np.arange(len(mask)), np.argmax(ranking, axis=1)
        precision, _ = self._sums(weight[rows, best] * mask, information, moment)
        covariance = dense.inverse(precision)
        log_evidence = likely[rows, best] + _volume(covariance)
        return _Means(mean[rows, best], covariance, good[rows, best] * mask, log_evidence)

    def _starts(self, row: NDArray[np.bool_], known: Array) -> Array:
        """(STARTS + 1, 6) where the search for the mean of a row starts: at some of its looks, and at what is known."""
        there = np.flatnonzero(row)
        if not len(there):
            return np.broadcast_to(known, (STARTS + 1, 6))
        some = there[np.linspace(len(there) - 1, 0, STARTS).round().astype(np.int64)]
        return np.concatenate([self.offset[some], known[None]])

    def _sums(self, weight: Array, information: Array, moment: Array) -> tuple[Array, Array]:
        """Sums of the information (..., 6, 6) and moments (..., 6) of what is known and of the looks, with weights
        (..., N)."""
        pulled = dense.applied(self.information, self.offset)
        precision = np.broadcast_to(information, (*weight.shape[:-1], 6, 6)).copy()
        moments = np.broadcast_to(moment, (*weight.shape[:-1], 6)).copy()
        for n in range(weight.shape[-1]):
            precision += weight[..., n, None, None] * self.information[n]
            moments += weight[..., n, None] * pulled[n]
        return precision, moments


def _volume(covariance: Array) -> Array:
    """(...) logarithm of the integral of exp(-½·xᵀ·C⁻¹·x)."""
    return np.asarray(0.5 * dense.log_determinant(dense.cholesky(covariance)) + 3.0 * log(2.0 * pi))
