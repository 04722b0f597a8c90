"""The Gaussian that comes nearest to the posterior of a window over its pose, lens and clocks.

The log-posterior has ripples: where an edge passes from one pixel to the next, and where two edges of a scene come to
lie on each other. They are as narrow as the posterior is wide, so its highest point and the curvature there depend on
where a search stopped. The nearest Gaussian (least Kullback-Leibler divergence from it) has neither: its mean μ and
covariance S are where the gradient and the curvature vanish and agree *on average over the Gaussian itself* (Opper,
Archambeau 2009),

    E[∇ log p] = 0,   E[-∇² log p] = S⁻¹.

They are the fixed point of natural-gradient steps (Khan, Lin 2017), whose averages are differences of the gradient
across the Gaussian, along orthogonal directions that change from step to step; the steps shrink (Robbins, Monro 1951),
so that the directions average out.

κ, the share of the range edges that is independent, is found along with them. It is the magnitude adjustment of a
composite likelihood (Pace, Salvan, Sartori 2011): from the curvature and from how the gradient scatters between frames
and between sectors of the image. If all edges were independent, both would be equal. Frames of one view agree with each
other, but their sectors do not: the smaller share of both counts. It is measured by turns, which move all edges about
alike; a shift moves the nearest by most. One number for all parameters, so that a few frames suffice.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import COLUMNS, ROWS, sectors
from coec.calibration.uncertainty.ascent import (
    CURVATURE_PX2,
    Ascent,
    Coordinates,
    Vector,
    inverse_root,
    metric,
)
from coec.calibration.uncertainty.displaced_edges import SIZE, TURNS, AssumedEdges
from coec.geometry import linalg
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.displaced_alignment import DisplacedEdges, of_sums

SPAN = sqrt(3.0)
"""Half the length of the differences, in standard deviations: between its ends lies a uniform distribution of the same
variance, and the difference of a gradient is the mean curvature on the way."""

LEAST_SPAN_PX = 0.5
"""Half the least length of the differences, root mean square of the edges: shorter ones only see the pixels. See
docs/measured.md."""

MEMORY, SETTLED = 4.0, 12
"""How fast steps shrink: step t after the whole ones counts `MEMORY` / (t + `MEMORY`), so that the first are forgotten;
from `SETTLED` on half as much memory averages more. See docs/measured.md."""

WIDE_START = 3.0
"""Standard deviations at the beginning, over those of coordinates in which a posterior is about as curved along each
axis: the Gaussian narrows from there, so that where it ends depends little on where it begins. See docs/measured.md."""

WHOLE_RATE = 0.8
"""Rate of the covariance in whole steps."""


@dataclass(frozen=True, slots=True)
class Effort:
    """How well a Gaussian is found.

    Attributes:
        whole: steps at the beginning that do not shrink.
        most: steps at most.
        tolerance: divergence (Kullback, Leibler) that the scatter of the steps may leave.
    """

    whole: int
    most: int
    tolerance: float


PRECISE, ROUGH, NEAR = Effort(4, 60, 0.002), Effort(2, 12, 0.1), Effort(2, 7, 0.1)
"""For what is reported to a few hundredths; for the odds of a hypothesis; and for these if the covariance is about
known. See docs/measured.md."""

LEAST_PRECISION = 0.1
"""A step widens the Gaussian by at most the root of the inverse of this."""

LINEAR = 0.5
"""Edges are linearised again once the mean is so many standard deviations from where they were."""

LEAST_SHARE, FEWEST = 1e-3, 3
"""Least κ, and fewest frames between which there is a scatter."""

TYPICAL_SHARE, TYPICAL_GROUPS = 0.3, 4
"""κ of other recordings, and how many groups of edges that knowledge is worth: the scatter between three frames may be
small by chance. See docs/measured.md."""

SCATTERED = 2
"""Sets of directions of a step; the scatter is measured at both ends of the first direction of each. See
docs/measured.md."""

REFLECTIONS = 3


@dataclass(frozen=True, slots=True, eq=False)
class GaussianFit:
    """The Gaussian next to a posterior.

    Attributes:
        mean: (13,) deviation.
        covariance: (13, 13); zero at places that are not free.
        independent_share: κ.
        significance: z at the top of the Gaussian, without ripples.
        log_posterior: at the top of the Gaussian, without ripples, up to a constant.
        log_evidence: logarithm of the integral of likelihood and normalised prior, up to the same constant.
    """

    mean: Vector
    covariance: NDArray[np.float64]
    independent_share: float
    significance: float
    log_posterior: float
    log_evidence: float


def fit_gaussian(
    level: AssumedEdges,
    start: Vector,
    places: tuple[int, ...],
    prior: Vector,
    share: float,
    *,
    effort: Effort,
    share_is_known: bool,
    covariance: NDArray[np.float64] | None = None,
) -> GaussianFit:
    """The Gaussian next to the posterior about a deviation.

    Args:
        level: the edges.
        start: (13,) where to begin.
        places: n places of the deviation that are free, turns first.
        prior: (13,) their standard deviations.
        share: κ; a first guess of it unless `share_is_known`.
        effort: how well.
        share_is_known: whether κ is given rather than to be found.
        covariance: (n, n) a first guess; without it, from how the edges move.

    Raises:
        ValueError: the edges in view do not determine the parameters, or how independent they are.
    """
    free, of_places, unit = list(places), prior[list(places)], np.eye(len(places))
    mean, local = start.copy(), _Local.about(level, start, places)
    if covariance is None:
        axes = Coordinates.about(level, start, places, prior, share).axes
        covariance = WIDE_START**2 * linalg.product(axes, axes.T)
    scatter, half_square = _Scatter(share, None if share_is_known else local), 0.0
    scattered, left = 0.0, 1.0
    for step in range(effort.most):
        late = step >= effort.whole
        part = _part(step - effort.whole) if late else 1.0
        rate = part if late else WHOLE_RATE
        factor = linalg.cholesky(covariance)
        if local.distance(mean, factor) > LINEAR:
            local = _Local.about(level, mean, places)
        span = local.span(mean, factor, step)
        sample = span.sample(*local.edges.gradients_across(span.centre, span.offsets))
        share_before = scatter.share
        scatter.add(local, mean, span, step, sample, rate if step else 1.0)
        gradient, curvature = _of_posterior(sample, scatter.share, factor, mean[free], of_places)
        root = _bounded_root(rate * curvature + (1.0 - rate) * unit)
        towards = part * linalg.cholesky_solve(root, gradient[:, None])[:, 0]
        half_square += part * (sample.top - half_square)
        mean = mean.copy()
        mean[free] += np.einsum("ij,j->i", factor, _bounded(towards))
        covariance = linalg.product(factor, linalg.cholesky_solve(root, factor.T))
        covariance = 0.5 * (covariance + covariance.T)
        # The divergence of a whole step, averaged as the Gaussian is. κ counts twice: its error is that of every axis.
        of_share = 2.0 * len(unit) * (log(scatter.share / share_before) / part) ** 2
        divergence = 0.5 * float(np.sum(gradient**2)) + 0.25 * (float(np.sum((curvature - unit) ** 2)) + of_share)
        scattered += part * (divergence - scattered)
        left = (1.0 - part) ** 2 * left + part**2
        if late and left * scattered < effort.tolerance:
            break
    scatter.check()
    return _fit(mean, covariance, scatter.share, half_square, places, prior)


def _part(step: int) -> float:
    """The share of itself that a step counts after the whole ones."""
    if step <= SETTLED:
        return MEMORY / (step + MEMORY)
    return MEMORY / (2.0 * step - SETTLED + MEMORY)


def _fit(
    mean: Vector,
    covariance: NDArray[np.float64],
    share: float,
    half_square: float,
    places: tuple[int, ...],
    prior: Vector,
) -> GaussianFit:
    """A Gaussian of covariance (n, n), with z²/2 at its top."""
    free, of_places, whole = list(places), prior[list(places)], np.zeros((SIZE, SIZE))
    whole[np.ix_(free, free)] = covariance
    volume = 0.5 * float(linalg.log_determinant(linalg.cholesky(covariance)))
    top = share * half_square - 0.5 * float(np.sum((mean[free] / of_places) ** 2))
    evidence = top + volume - float(np.sum(np.log(of_places)))
    return GaussianFit(mean, whole, share, sqrt(max(2.0 * half_square, 0.0)), top, evidence)


def covariance_under(
    fit: GaussianFit, places: tuple[int, ...], prior: Vector, other: Vector
) -> NDArray[np.float64] | None:
    """(n, n) the covariance of a Gaussian of one prior (13,) under another (13,); None if the edges do not bound it."""
    free = list(places)
    try:
        precision = linalg.inverse(fit.covariance[np.ix_(free, free)])
        return linalg.inverse(precision + np.diag(other[free] ** -2.0 - prior[free] ** -2.0))
    except ValueError:
        return None


def upper_bound(
    end: Ascent, share: float, covariance: NDArray[np.float64], places: tuple[int, ...], prior: Vector
) -> GaussianFit:
    """A Gaussian of covariance (n, n) about the highest point of a posterior: it has more evidence than the one next
    to the posterior, which ripples make lower."""
    return _fit(end.deviation, covariance, share, 0.5 * max(end.significance, 0.0) ** 2, places, prior)


GROUPS, COLUMN_GROUPS = 8, 4
"""Most groups of frames, and groups of columns of sectors, that are left out in turn."""

DELETION_SETS, DELETION_STEPS = 4, 3
"""Sets of directions over which the gradient without a group is averaged at the mean of all edges, and steps from there
on its paraboloid; one more follows on the edges. See docs/measured.md."""


def deletion_covariance(
    level: AssumedEdges, fit: GaussianFit, places: tuple[int, ...], prior: Vector
) -> NDArray[np.float64]:
    """(13, 13) by how much the mean of a Gaussian moves if a group of frames, or a part of the image, is left out: the
    sum of both delete-group jackknife covariances (Shao, Wu 1989).

    Curvatures describe the hill on which the mean lies. A few edges more or less may put it onto a neighbouring one.
    All groups begin at the same points: their sums there are those of all edges less those of the group.
    """
    free, frames = list(places), len(level.frames.maps)
    local, factor = _Local.about(level, fit.mean, places), linalg.cholesky(fit.covariance[np.ix_(free, free)])
    count = min(frames, GROUPS)
    of_frames = local.edges.frame.astype(np.int64) * count // frames
    of_columns = local.sectors() // ROWS * COLUMN_GROUPS // COLUMNS
    spans = [local.span(fit.mean, factor, k) for k in range(DELETION_SETS)]
    points = np.concatenate([span.centre + sign * span.offsets for span in spans for sign in (1.0, -1.0)])
    sums = local.edges.cell_sums(of_frames * COLUMN_GROUPS + of_columns, count * COLUMN_GROUPS, points, len(free))
    sums = sums.reshape(DELETION_SETS, 2, len(free), count, COLUMN_GROUPS, -1)
    covariance = np.zeros((SIZE, SIZE))
    for group, each in ((of_frames, sums.sum(axis=4)), (of_columns, sums.sum(axis=3))):
        number = each.shape[3]
        if number < FEWEST:
            continue
        means = []
        for k in range(number):
            rest = each.sum(axis=3) - each[:, :, :, k]
            samples = [span.sample(*of_sums(one)) for span, one in zip(spans, rest, strict=True)]
            without = np.where(group == k, np.float32(0.0), local.edges.weight)
            others = replace(local, edges=replace(local.edges, weight=without))
            means.append(_mean_without(others, samples, fit, factor, prior[free]))
        off = np.array(means) - np.mean(means, axis=0)
        covariance[np.ix_(free, free)] += np.einsum("gi,gj->ij", off, off) * (number - 1) / number
    return covariance


def _mean_without(
    local: "_Local", samples: "list[_Sample]", fit: GaussianFit, factor: NDArray[np.float64], prior: Vector
) -> Vector:
    """(n,) the mean of a Gaussian of given covariance without a group of edges, from samples of the other ones at the
    mean of all."""
    at, share = fit.mean[local.free], fit.independent_share
    each = [_of_posterior(sample, share, factor, at, prior) for sample in samples]
    gradient, curvature = (np.mean(values, axis=0) for values in zip(*each, strict=True))
    step = np.zeros(len(prior))
    for _ in range(DELETION_STEPS):
        step += _bounded(gradient - np.einsum("ij,j->i", curvature, step))
    mean = fit.mean.copy()
    mean[local.free] = at + np.einsum("ij,j->i", factor, step)
    span = local.span(mean, factor, len(samples))
    sample = span.sample(*local.edges.gradients_across(span.centre, span.offsets))
    gradient, _ = _of_posterior(sample, share, factor, mean[local.free], prior)
    return np.asarray(mean[local.free] + np.einsum("ij,j->i", factor, _bounded(gradient)))


def _bounded(towards: Vector) -> Vector:
    """A step of at most a standard deviation along each coordinate."""
    return np.asarray(towards / max(1.0, float(np.max(np.abs(towards)))))


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """z²/2 across a Gaussian, in coordinates in which its covariance is one: its mean gradient (n,), its mean negative
    Hessian (n, n), and its value at the top without ripples."""

    gradient: Vector
    curvature: NDArray[np.float64]
    top: float


def _of_posterior(
    sample: _Sample, share: float, factor: NDArray[np.float64], mean: Vector, prior: Vector
) -> tuple[Vector, NDArray[np.float64]]:
    """The mean gradient (n,) and negative Hessian (n, n) of the log-posterior in the coordinates of a sample."""
    whitened = factor / prior[:, None]
    gradient = share * sample.gradient - np.einsum("ij,i->j", whitened, mean / prior)
    return gradient, share * sample.curvature + linalg.product(whitened.T, whitened)


@dataclass(frozen=True, slots=True, eq=False)
class _Span:
    """Differences across a Gaussian: from `centre` (n,) plus each of the offsets (n, n) to `centre` minus it. These are
    `reach` (n,) standard deviations long, along orthogonal `directions` (n, n) of the coordinates in which the
    covariance L·Lᵀ is one; `factor` (n, n) is L."""

    centre: Vector
    offsets: NDArray[np.float64]
    reach: Vector
    directions: NDArray[np.float64]
    factor: NDArray[np.float64]

    def sample(self, z: NDArray[np.float64], gradients: NDArray[np.float64]) -> _Sample:
        """From z (2, n) at both ends of the differences and its gradients (2, n, n)."""
        z = np.maximum(z, 0.0)
        slopes = z[:, :, None] * gradients
        differences = (slopes[1] - slopes[0]) / (2.0 * self.reach)[:, None]
        along = linalg.product(differences, self.factor)
        curvature = linalg.product(self.directions.T, along)
        of_directions = np.einsum("ki,ki->k", along, self.directions)
        tops = 0.25 * (z[0] ** 2 + z[1] ** 2) + 0.5 * self.reach**2 * of_directions
        gradient = linalg.product(self.factor.T, slopes.mean(axis=(0, 1))[:, None])[:, 0]
        curvature = 0.5 * (curvature + curvature.T)
        return _Sample(gradient, curvature, float(tops.mean()))


@dataclass(frozen=True, slots=True, eq=False)
class _Local:
    """The edges as a linear function of n places of a deviation, turns first, about a point `at` (13,). `metric`
    (n, n): see `ascent.metric`."""

    edges: DisplacedEdges
    at: Vector
    free: list[int]
    metric: NDArray[np.float64]

    @classmethod
    def about(cls, level: AssumedEdges, at: Vector, places: tuple[int, ...]) -> "_Local":
        edges = level.at(at, places)
        return cls(edges, at, list(places), metric(edges))

    def sectors(self) -> NDArray[np.int64]:
        """(E,) sector of the image of each edge; 0 beside it."""
        seen = self.edges.uv_px[0] >= 0.0
        sector = np.zeros(len(seen), np.int64)
        sector[seen] = sectors(self.edges.uv_px.T[seen].astype(np.float64))
        return sector

    def distance(self, mean: Vector, factor: NDArray[np.float64]) -> float:
        """How far a mean (13,) is from here, in standard deviations of a covariance with this factor (n, n)."""
        off = (mean - self.at)[self.free]
        return sqrt(max(float(np.sum(off * linalg.cholesky_solve(factor, off[:, None])[:, 0])), 0.0))

    def span(self, mean: Vector, factor: NDArray[np.float64], step: int) -> _Span:
        """Across the Gaussian about `mean` (13,), along other directions for each step."""
        directions = _orthogonal(len(self.free), step)
        along = linalg.product(directions, factor.T)
        rms_px = np.sqrt(np.maximum(linalg.squared(self.metric[None], along), 0.0))
        reach = np.maximum(SPAN, LEAST_SPAN_PX / np.maximum(rms_px, 1e-9))
        return _Span((mean - self.at)[self.free], reach[:, None] * along, reach, directions, factor)


class _Scatter:
    """κ from the curvature of z²/2 along turns and the scatter of its gradient, as they are averaged; known if no edges
    are given."""

    def __init__(self, share: float, local: _Local | None) -> None:
        self.share = share
        self._known = local is None
        if local is None:
            return
        # Axes of a turn, in columns, along each of which the edges move about alike.
        self._turns = inverse_root(CURVATURE_PX2 * local.metric[: len(TURNS), : len(TURNS)])
        self._frames = len(local.edges.maps)
        self._cell = local.edges.frame * (COLUMNS * ROWS) + local.sectors()
        self._curvature = 0.0
        self._scatter = np.zeros(2)
        self._added = 0

    def add(self, local: _Local, mean: Vector, span: _Span, step: int, sample: _Sample, rate: float) -> None:
        """Adds a sample across a Gaussian."""
        if self._known:
            return
        turns = np.zeros((len(local.free), len(TURNS)))
        turns[: len(TURNS)] = self._turns
        factor = span.factor
        inside = linalg.product(factor.T, linalg.cholesky_solve(factor, turns))
        curvature = float(np.sum(linalg.squared(sample.curvature[None], inside.T)))
        cells = self._frames * COLUMNS * ROWS
        others = (local.span(mean, factor, step + k * PRECISE.most) for k in range(1, SCATTERED))
        points = np.array([one.centre + sign * one.offsets[0] for one in (span, *others) for sign in (1.0, -1.0)])
        sums = local.edges.cell_sums(self._cell, cells, points, len(TURNS))
        total = np.cumsum(sums, axis=1)[:, -1]
        scale = np.maximum(total[:, 0], 0.0) / np.maximum(total[:, 1], LEAST_SQUARE)
        slopes = scale[:, None, None] * np.einsum("pcn,nk->pkc", sums[:, :, 2:], self._turns)
        slopes = slopes.reshape(len(points), len(TURNS), self._frames, COLUMNS * ROWS)
        scatter = np.array([_scatter(slopes.sum(axis=axis)) for axis in (3, 2)])
        self._curvature += rate * (curvature - self._curvature)
        self._scatter += rate * (scatter - self._scatter)
        self._added += 1
        if self._added > 2:
            inflation = self._scatter / max(self._curvature, LEAST_SQUARE)
            groups = np.array(slopes.shape[2:])
            shrunk = (groups * inflation + TYPICAL_GROUPS / TYPICAL_SHARE) / (groups + TYPICAL_GROUPS)
            self.share = min(max(1.0 / float(shrunk.max(where=groups >= FEWEST, initial=1.0)), LEAST_SHARE), 1.0)

    def check(self) -> None:
        """Raises ValueError if the samples do not show how independent the edges are."""
        if not self._known and not (self._curvature > 0.0 and self._scatter.max() > 0.0):
            raise ValueError("the edges in view do not determine how independent they are")


def _scatter(slopes: NDArray[np.float64]) -> float:
    """The variance of a sum of m groups that are independent, from the groups (p, n, m) at p points, added up over n; 0
    if there are too few groups."""
    count = slopes.shape[-1]
    if count < FEWEST:
        return 0.0
    centred = slopes - slopes.mean(axis=-1)[..., None]
    return float(np.sum(centred * centred) * count / (count - 1) / len(slopes))


def _bounded_root(precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, n) Cholesky factor of a precision; where that is small or negative it is increased.

    Raises:
        ValueError: the precision is not finite.
    """
    if not np.isfinite(precision).all():
        raise ValueError("the edges in view do not determine the parameters")
    more, unit = 0.0, np.eye(len(precision))
    while True:
        try:
            linalg.cholesky(precision + (more - LEAST_PRECISION) * unit)
        except ValueError:
            more = max(2.0 * more, LEAST_PRECISION)
        else:
            return linalg.cholesky(precision + more * unit)


@lru_cache(maxsize=8 * PRECISE.most)
def _orthogonal(n: int, step: int) -> NDArray[np.float64]:
    """(n, n) orthogonal directions in rows, others for each step: a product of reflections (Householder 1958)."""
    rng = np.random.default_rng(step)
    directions = np.eye(n)
    for _ in range(REFLECTIONS):
        normal = rng.integers(-1000, 1001, n).astype(np.float64)
        directions -= (2.0 / float(np.einsum("i,i", normal, normal))) * np.outer(
            np.einsum("ij,j->i", directions, normal), normal
        )
    return directions
