"""Observations of one edge of the rig, from a window (strong, minutes apart), a check (quick, seconds apart) or a
registration of two LiDARs; their history; and the step of the edge at some time that they show: where the edge was
before, where it is since, and how well that is known.

An accepted window tells a step by itself if what was served rests on windows, too: both have the bias of the one
estimator, which cancels, while the bias of checks is another and may be larger than a step.

Of the looks, each side is a robust mean. A good look is Student-distributed about the place of the edge; a bad look
lies anywhere within reach. This is the model of `sequential_tests`, in all six axes at once. The mean is the mode of
that mixture, found by expectation maximisation from several looks; the likeliest end is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import lgamma, log, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import STREET, UNCOMMISSIONED_BIAS
from coec.calibration.monitor import sequential_tests
from coec.calibration.monitor.change_detector import ROTATIONS, TRANSLATIONS, Observation, measurement_on_axes
from coec.calibration.rig.lidar_sampling import KNOWN_BEFORE
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry import linalg, se3
from coec.geometry.linalg import eigen

BIAS_TIMES = 2.0
"""The first looks of a rig, and a window beside them, are trusted only to this multiple of the usual bias of looks: the
next rig may have a larger bias than the few that are known, and a bias must not pass for a move."""

LEAST_SIGMA, MOST_SIGMA = 1e-6, 10.0
"""Limits of the standard deviation of a look, rad or m. Below the lower one its numbers are no evidence but a fault of
the sender; from the upper one on an axis counts as not determined."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeObservation:
    """Where one look at an edge puts it.

    Attributes:
        edge: its name.
        stamp_ns: sensor time of the last pair of frames.
        T_a_b: (4, 4).
        information: (6, 6) inverse of the covariance of the error that is new at every look, about the axes of a; zero
            on axes that are not determined.
        place: (6,) standard deviation of the error that neighbouring looks share and looks elsewhere do not.
        rig: (6,) standard deviation of the error that is the same everywhere: the unknown bias of the estimator.
        share: how much it counts, 0 to 1: the part of its frames that no earlier look held.
        weak: whether it has little evidence, and may lie anywhere.
        stepped_ns: stamp of the first frame since which the pair by itself suspects a step; None if it suspects none.
            It adds a time at which a step is looked for, and a sensor with one pair is named by looks only if it is
            set.
        window: (6, 6) if the look is an accepted window, the covariance of its error without the bias of the estimator,
            which windows have in common; NaN on axes that it does not determine.
    """

    edge: str
    stamp_ns: int
    T_a_b: Matrix4
    information: NDArray[np.float64]
    place: NDArray[np.float64]
    rig: NDArray[np.float64]
    share: float = 1.0
    weak: bool = False
    stepped_ns: int | None = None
    window: NDArray[np.float64] | None = None

    @property
    def log_bad(self) -> float:
        """Logarithm of the share of bad looks among looks such as this."""
        return log(sequential_tests.BAD_SHARE_WEAK if self.weak else sequential_tests.BAD_SHARE)

    @property
    def log_bad_again(self) -> float:
        """Logarithm of the chance that it is bad in the same place as the look before it, if that one was bad."""
        return log(
            sequential_tests.BAD_SHARE_WEAK * sequential_tests.SAME_AGAIN_WEAK
            if self.weak
            else sequential_tests.BAD_AFTER_BAD * sequential_tests.SAME_AGAIN
        )


def information_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) inverse of a covariance (6, 6) over the axes that it determines (finite, below `MOST_SIGMA`), zero
    elsewhere.

    Raises:
        ValueError: it has another shape, determines no axis, is not symmetric and positive definite on those axes, or
            is absurdly small there.
    """
    if covariance.shape != (6, 6):
        raise ValueError(f"a covariance must have the shape (6, 6), got {covariance.shape}")
    variances = covariance.diagonal()
    with np.errstate(invalid="ignore"):
        determined = np.flatnonzero(np.isfinite(variances) & (variances < MOST_SIGMA**2))
    if not len(determined):
        raise ValueError("a covariance determines no axis: every variance is missing or too large")
    block = covariance[np.ix_(determined, determined)]
    if not np.isfinite(block).all() or (variances[determined] < LEAST_SIGMA**2).any():
        raise ValueError("a covariance is not finite, or smaller than the resolution of any sensor")
    if np.abs(block - block.T).max() > 1e-6 * np.abs(block).max():
        raise ValueError("a covariance is not symmetric")
    # Scaled to a unit diagonal: radians and metres differ by powers of ten.
    scale = 1.0 / np.sqrt(variances[determined])
    inner = linalg.inverse(0.5 * (block + block.T) * scale[:, None] * scale)
    information = np.zeros((6, 6))
    information[np.ix_(determined, determined)] = inner * scale[:, None] * scale
    return information


def observation_of_check(
    edge: str, T_served: Matrix4, observation: Observation, share: float = 1.0, stepped_ns: int | None = None
) -> EdgeObservation | None:
    """The look that a check of the pose `T_served` (4, 4) is; None if the check says nothing of the mount, because the
    data were at fault, it holds no new frame, or it determines no axis. For `stepped_ns` see `EdgeObservation`.

    Raises:
        ValueError: the pose is not rigid, or the offset is not six numbers.
    """
    _rigid(edge, T_served)
    if observation.causes or not share > 0.0:
        return None
    offset, variance = np.zeros(6), np.full(6, np.inf)
    place, rig = np.zeros(6), np.zeros(6)
    # Here looks at poor scenes count among the bad ones: their share was learned with the scatter of a street for all.
    observation = replace(observation, dispersion=1.0)
    for axes in (slice(0, 3), slice(3, 6)):
        measurement = measurement_on_axes(observation, axes, None)
        if measurement is not None:
            offset[axes], variance[axes] = measurement.offset, measurement.noise
            place[axes], rig[axes] = np.sqrt(measurement.place), np.sqrt(measurement.rig)
    if not np.isfinite(variance).any():
        return None
    return EdgeObservation(
        edge=edge,
        stamp_ns=observation.stamp_ns,
        T_a_b=se3.perturb(T_served, offset),
        information=information_of(np.diag(variance)),
        place=place,
        rig=rig,
        share=min(share, 1.0),
        weak=observation.weak,
        stepped_ns=stepped_ns,
    )


def observation_of_window(edge: str, window: Measurement) -> EdgeObservation | None:
    """The look that an accepted window is; None if the window determines no axis.

    Its frames share a street, so the errors that they have in common count as noise here. So does the bias of the
    estimator in `information`: checks have another bias, and the difference would look like a step.

    Raises:
        ValueError: the pose is not rigid, or the covariance is invalid.
    """
    _rigid(edge, window.T_camera_lidar)
    if not window.determined_axes():
        return None
    covariance = window.uncertainty.covariance
    relative_to_checks = covariance + np.diag((BIAS_TIMES * UNCOMMISSIONED_BIAS) ** 2)
    return EdgeObservation(
        edge=edge,
        stamp_ns=window.stamp_ns,
        T_a_b=window.T_camera_lidar,
        information=information_of(relative_to_checks),
        place=STREET,
        rig=UNCOMMISSIONED_BIAS,
        window=covariance,
    )


def _rigid(edge: str, pose: Matrix4) -> None:
    if not se3.is_rigid(pose):
        raise ValueError(f"{edge}: a pose must be a rigid transform (4, 4) of finite numbers")


Array = NDArray[np.float64]

MAX_OBSERVATIONS = 24
"""Looks of each edge that are kept one by one: two minutes at one every five seconds. Older ones are counted
together."""

MEMORY_OBSERVATIONS = 360.0
"""The older looks together count as this many at most: half an hour, so that the mean follows a mount that creeps."""

REACH = np.array([*ROTATIONS.reach, *TRANSLATIONS.reach])
"""(6,) standard deviation of the offsets of bad looks (rad, m)."""

MOST_WINDOWS = 4
"""Most windows of an edge that are kept: three may be urgent in one suspicion (`urgent_window_since`)."""

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
        observations: the kept looks in the order of their stamps, `MAX_OBSERVATIONS` at most.
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
        moment = keep * self.moment + weight * linalg.applied(oldest.information, offset)
        return replace(recent, information=information, moment=moment)

    @property
    def sigma(self) -> Array:
        """(6,) standard deviation of where the edge was before the kept looks; NaN where nothing is known."""
        variance = linalg.inverse(self.information).diagonal()
        return np.sqrt(np.where(variance < 0.99 * MOST_SIGMA**2, variance, np.nan))

    @property
    def mean(self) -> Array:
        """(6,) the offset, by what is known from before the kept looks."""
        return np.asarray(linalg.cholesky_solve(linalg.cholesky(self.information), self.moment[:, None])[:, 0])

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
        observations: (T,) number of good looks since.
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
        return log(sequential_tests.BAD_SHARE) + float(_log_normal(np.diag(REACH[self.axes] ** 2), self.xi))

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
        within = linalg.product(reach, linalg.inverse(block + reach))  # what looks tell, against the reach of a step
        difference = self.xi - linalg.applied(within, xi[..., self.axes])
        return np.asarray(_LOG_GOOD + _log_normal(linalg.product(within, block) + self.covariance, difference))

    def combined(self, steps: EdgeSteps) -> EdgeSteps:
        """The steps with what the window says of them."""
        block, difference = steps.covariance[:, self.axes[:, None], self.axes], self.xi - steps.xi[:, self.axes]
        fits = self.after & (self._log_good(steps.xi, steps.covariance) > self.log_bad)
        # Kalman's gain.
        gain = linalg.product(steps.covariance[:, :, self.axes], linalg.inverse(block + self.covariance))
        less = linalg.product(gain, np.swapaxes(steps.covariance[:, :, self.axes], -1, -2))
        log_fit = np.where(fits, _LOG_GOOD + _log_normal(block + self.covariance, difference), self.log_bad)
        return replace(
            steps,
            xi=steps.xi + np.where(fits[:, None], linalg.applied(gain, difference), 0.0),
            covariance=steps.covariance - np.where(fits[:, None, None], 0.5 * (less + np.swapaxes(less, -1, -2)), 0.0),
            observations=steps.observations + fits,
            # Looks that are bad for a while have to have a bad window beside them.
            log_transient=steps.log_transient + np.where(fits, log(sequential_tests.BAD_SHARE), 0.0),
            log_stepped=steps.log_stepped + np.where(self.after, log_fit, self.log_still),
            log_still=steps.log_still + self.log_still,
        )


_LOG_GOOD = log(1.0 - sequential_tests.BAD_SHARE)


def _log_normal(covariance: Array, x: Array) -> Array:
    """(...) logarithm of the density of a normal distribution about 0 with the covariance (..., n, n) at x (..., n)."""
    factor = linalg.cholesky(covariance)
    q = np.sum(x * linalg.cholesky_solve(factor, x[..., None])[..., 0], axis=-1)
    return np.asarray(-0.5 * (q + linalg.log_determinant(factor) + x.shape[-1] * log(2.0 * pi)))


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
        spread = linalg.log_determinant(linalg.cholesky(whole))
        bad = np.exp([observation.log_bad for observation in observations])
        constant = np.array(
            [
                lgamma((sequential_tests.FREEDOM + d) / 2.0) - lgamma(sequential_tests.FREEDOM / 2.0)
                for d in axes.tolist()
            ]
        )
        log_good = np.log1p(-bad) + constant - 0.5 * axes * log(sequential_tests.FREEDOM * pi) + 0.5 * spread
        within = np.where(determined, -0.5 * (offset / REACH) ** 2 - np.log(REACH) - 0.5 * log(2.0 * pi), 0.0)
        share = np.array([observation.share for observation in observations])
        return cls(offset, information, axes, log_good, np.log(bad) + within.sum(axis=1), share)

    def weights(self, mean: Array) -> tuple[Array, Array, Array]:
        """For each look about a mean (T, S, 6): its log density, its weight in the next mean, and how far it is a good
        one; each (T, S, N)."""
        away = self.offset - mean[:, :, None, :]
        q = linalg.squared(self.information, away)
        log_good = self.log_good - 0.5 * (sequential_tests.FREEDOM + self.axes) * np.log1p(q / sequential_tests.FREEDOM)
        density = np.logaddexp(log_good, self.log_bad)
        good = self.share * np.exp(log_good - density)
        return (
            self.share * density,
            good * np.minimum((sequential_tests.FREEDOM + self.axes) / (sequential_tests.FREEDOM + q), 1.0),
            good,
        )

    def mean(
        self, mask: NDArray[np.bool_], information: Array, moment: Array, extra: ExtraLikelihood | None = None
    ) -> _Means:
        """The means of the looks in each row of a mask (T, N), combined with what else is known. Of several, the one is
        taken that is likeliest by the looks and by what is known `beside` them."""
        known = linalg.cholesky_solve(linalg.cholesky(information), moment[:, None])[:, 0]
        if not len(self.offset):
            covariance = np.broadcast_to(linalg.inverse(information), (len(mask), 6, 6))
            return _Means(
                np.broadcast_to(known, (len(mask), 6)), covariance, np.zeros((len(mask), 0)), _volume(covariance)
            )
        mean = np.stack([self._starts(row, known) for row in mask])
        for _ in range(TURNS):
            weight = self.weights(mean)[1] * mask[:, None, :]
            precision, moments = self._sums(weight, information, moment)
            mean = linalg.cholesky_solve(linalg.cholesky(precision), moments[..., None])[..., 0]
        density, weight, good = self.weights(mean)
        difference = mean - known
        likely = (density * mask[:, None, :]).sum(axis=-1) - 0.5 * linalg.squared(information, difference)
        ranking = likely
        if extra is not None:
            precision, _ = self._sums(weight * mask[:, None, :], information, moment)
            ranking = likely + extra(mean, linalg.inverse(precision))
        rows, best = np.arange(len(mask)), np.argmax(ranking, axis=1)
        precision, _ = self._sums(weight[rows, best] * mask, information, moment)
        covariance = linalg.inverse(precision)
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
        pulled = linalg.applied(self.information, self.offset)
        precision = np.broadcast_to(information, (*weight.shape[:-1], 6, 6)).copy()
        moments = np.broadcast_to(moment, (*weight.shape[:-1], 6)).copy()
        for n in range(weight.shape[-1]):
            precision += weight[..., n, None, None] * self.information[n]
            moments += weight[..., n, None] * pulled[n]
        return precision, moments


def _volume(covariance: Array) -> Array:
    """(...) logarithm of the integral of exp(-½·xᵀ·C⁻¹·x)."""
    return np.asarray(0.5 * linalg.log_determinant(linalg.cholesky(covariance)) + 3.0 * log(2.0 * pi))


PLACE = np.array([radians(0.02)] * 3 + [0.004] * 3)
"""Standard deviation by which the pose between two LiDARs differs from street to street, beyond what a registration
claims (rad, m). See docs/measured.md."""

BIAS = np.array([radians(0.03)] * 3 + [0.006] * 3)
"""Standard deviation of the error that is the same on every street: errors of angle and range that belong to the two
sensors (rad, m). See docs/measured.md."""

DETERMINED_SHARE = 0.3
"""A look determines a direction if its standard deviation there is below this share of what is known before it: below
3° and 30 cm."""

UNDETERMINED_TIMES = 5.0
"""Standard deviation of a direction that is not determined, as a multiple of what is known before a look: two minutes
of such looks together then say less than was known before."""


def determined_covariance(covariance: Array) -> Array | None:
    """The covariance (6, 6) of what the surroundings determined; None if they determined no direction. Directions in
    which they say hardly more than was known before are made so wide that they count as not determined.

    Raises:
        ValueError: the covariance is not (6, 6) or not finite.
    """
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError("a covariance must be (6, 6) finite numbers")
    unit = KNOWN_BEFORE[:, None] * KNOWN_BEFORE
    widened, any_determined = np.zeros((6, 6)), False
    for value, vector in eigen((0.5 * (covariance + covariance.T) / unit).tolist()):
        determined = value < DETERMINED_SHARE**2
        any_determined |= determined
        widened += (value if determined else UNDETERMINED_TIMES**2) * np.outer(vector, vector)
    return widened * unit if any_determined else None


def observation_of_registration(edge: str, stamp_ns: int, T_a_b: Matrix4, covariance: Array) -> EdgeObservation:
    """A look at an edge that found `T_a_b` (4, 4); `covariance` (6, 6) is that of the registration.

    Raises:
        ValueError: the covariance is invalid.
    """
    return EdgeObservation(edge, stamp_ns, T_a_b, information_of(covariance), PLACE, BIAS)


def window_of(stamp_ns: int, T_a_b: Matrix4, covariance: Array) -> Measurement:
    """The same for the joint estimate. There it stands for all looks at the edge, so the errors that they have in
    common count as noise."""
    return Measurement(T_a_b, Uncertainty(covariance + np.diag(PLACE**2 + BIAS**2), {}, float("nan")), stamp_ns)
