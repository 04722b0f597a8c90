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
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import COLUMNS, ROWS, sectors
from coec.calibration.uncertainty.ascent import CURVATURE_PX2, METRIC_POINTS, Coordinates, Vector, inverse_root, metric
from coec.calibration.uncertainty.displaced_edges import SIZE, TURNS, AssumedEdges
from coec.geometry import linalg
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.displaced_alignment import DisplacedEdges

SPAN = sqrt(3.0)
"""Half the length of the differences, in standard deviations: between its ends lies a uniform distribution of the same
variance, and the difference of a gradient is the mean curvature on the way."""

LEAST_SPAN_PX = 0.5
"""Half the least length of the differences, root mean square of the edges: shorter ones only see the pixels. See
docs/measured.md."""

WARM_UP, MEMORY = 4, 4.0
"""Whole steps at the beginning; and how fast those after it shrink: step t after the warm-up counts
`MEMORY` / (t + `MEMORY`). See docs/measured.md."""

PRECISE, ROUGH = 60, 12
"""Steps for what is reported to a few hundredths, and for the odds of a hypothesis."""

WARM_UP_RATE = 0.8
"""Rate of the covariance in whole steps."""

LEAST_PRECISION = 0.1
"""A step widens the Gaussian by at most the root of the inverse of this."""

LINEAR = 0.5
"""Edges are linearised again once the mean is so many standard deviations from where they were."""

LEAST_SHARE, FEWEST = 1e-3, 3
"""Least κ, and fewest frames between which there is a scatter."""

TYPICAL_SHARE, TYPICAL_GROUPS = 0.3, 4
"""κ of other recordings, and how many groups of edges that knowledge is worth: the scatter between three frames may be
small by chance. See docs/measured.md."""

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
    steps: int,
    share_is_known: bool,
) -> GaussianFit:
    """The Gaussian next to the posterior about a deviation.

    Args:
        level: the edges.
        start: (13,) where to begin.
        places: n places of the deviation that are free, turns first.
        prior: (13,) their standard deviations.
        share: κ; a first guess of it unless `share_is_known`.
        steps: how many.
        share_is_known: whether κ is given rather than to be found.

    Raises:
        ValueError: the edges in view do not determine the parameters, or how independent they are.
    """
    free, of_places, n = list(places), prior[list(places)], len(places)
    mean, scatter = start.copy(), _Scatter(share, share_is_known)
    axes = Coordinates.about(level, start, places, prior, share).axes
    covariance = linalg.product(axes, axes.T)
    local = _Local.about(level, mean, places)
    half_square = 0.0
    for step in range(steps):
        late = step >= WARM_UP
        rate = MEMORY / (step - WARM_UP + MEMORY) if late else WARM_UP_RATE
        factor = linalg.cholesky(covariance)
        if local.distance(mean, factor) > LINEAR:
            local = _Local.about(level, mean, places)
        sample = local.sample(mean, factor, _orthogonal(n, step))
        scatter.add(local, sample, factor, rate if step else 1.0)
        whitened, off = factor / of_places[:, None], mean[free] / of_places
        curvature = scatter.share * sample.curvature + linalg.product(whitened.T, whitened)
        gradient = scatter.share * sample.gradient - np.einsum("ij,i->j", whitened, off)
        root = _bounded_root(rate * curvature + (1.0 - rate) * np.eye(n))
        towards = linalg.cholesky_solve(root, gradient[:, None])[:, 0] * (rate if late else 1.0)
        half_square += (rate if late else 1.0) * (sample.top - half_square)
        mean = mean.copy()
        mean[free] += np.einsum("ij,j->i", factor, towards / max(1.0, float(np.max(np.abs(towards)))))
        covariance = linalg.product(factor, linalg.cholesky_solve(root, factor.T))
        covariance = 0.5 * (covariance + covariance.T)
    scatter.check()
    whole = np.zeros((SIZE, SIZE))
    whole[np.ix_(free, free)] = covariance
    volume = 0.5 * float(linalg.log_determinant(linalg.cholesky(covariance)))
    top = scatter.share * half_square - 0.5 * float(np.sum((mean[free] / of_places) ** 2))
    evidence = top + volume - float(np.sum(np.log(of_places)))
    return GaussianFit(mean, whole, scatter.share, sqrt(max(2.0 * half_square, 0.0)), top, evidence)


GROUPS, COLUMN_GROUPS = 8, 4
"""Most groups of frames, and groups of columns of sectors, that are left out in turn."""

DELETION_STEPS = 4
"""Steps from the mean of all edges to that without a group. See docs/measured.md."""


def deletion_covariance(
    level: AssumedEdges, fit: GaussianFit, places: tuple[int, ...], prior: Vector
) -> NDArray[np.float64]:
    """(13, 13) by how much the mean of a Gaussian moves if a group of frames, or a part of the image, is left out: the
    sum of both delete-group jackknife covariances (Shao, Wu 1989).

    Curvatures describe the hill on which the mean lies. A few edges more or less may put it onto a neighbouring one.
    """
    free, frames = list(places), len(level.frames.first_point) - 1
    local, factor = _Local.about(level, fit.mean, places), linalg.cholesky(fit.covariance[np.ix_(free, free)])
    of_frames = np.repeat(
        np.arange(frames) * min(frames, GROUPS) // frames, np.diff(level.frames.first_point).astype(np.int64)
    )
    of_columns = local.cell.astype(np.int64) // ROWS * COLUMN_GROUPS // COLUMNS
    covariance = np.zeros((SIZE, SIZE))
    for group in (of_frames, of_columns):
        count = int(group.max(initial=0)) + 1
        if count < FEWEST:
            continue
        means = np.array([_mean_without(local, group == k, fit, factor, prior) for k in range(count)])
        off = means - means.mean(axis=0)
        covariance += np.einsum("gi,gj->ij", off, off) * (count - 1) / count
    return covariance


def _mean_without(
    local: "_Local", left_out: NDArray[np.bool_], fit: GaussianFit, factor: NDArray[np.float64], prior: Vector
) -> Vector:
    """(13,) the mean of a Gaussian of given covariance with some edges (E,) left out."""
    weight = np.where(left_out, np.float32(0.0), local.edges.weight)
    rest, free, mean = replace(local, edges=replace(local.edges, weight=weight)), local.free, fit.mean.copy()
    whitened = factor / prior[free][:, None]
    for step in range(DELETION_STEPS):
        sample = rest.sample(mean, factor, _orthogonal(len(free), step))
        gradient = fit.independent_share * sample.gradient - np.einsum("ij,i->j", whitened, mean[free] / prior[free])
        towards = gradient * min(1.0, 2.0 / (step + 1))
        mean[free] += np.einsum("ij,j->i", factor, towards / max(1.0, float(np.max(np.abs(towards)))))
    return mean


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """z²/2 across a Gaussian, in coordinates in which its covariance is one: its mean gradient (n,), its mean negative
    Hessian (n, n), and its value at the top without ripples. `point` (n,) is one of the places where it was taken,
    `of_point` z there."""

    gradient: Vector
    curvature: NDArray[np.float64]
    top: float
    point: Vector
    of_point: float


@dataclass(frozen=True, slots=True, eq=False)
class _Local:
    """The edges as a linear function of n places of a deviation, turns first, about a point `at` (13,).

    Attributes:
        metric: (n, n) see `ascent.metric`.
        turns: (3, 3) axes of a turn, in columns, along each of which the edges move about alike.
        cell: (E,) sector of the image of each edge.
    """

    edges: DisplacedEdges
    at: Vector
    free: list[int]
    metric: NDArray[np.float64]
    turns: NDArray[np.float64]
    cell: NDArray[np.uint8]

    @classmethod
    def about(cls, level: AssumedEdges, at: Vector, places: tuple[int, ...]) -> "_Local":
        edges = level.at(at, places)
        of_all = metric(edges, METRIC_POINTS)
        seen = edges.uv_px[0] >= 0.0
        cell = np.zeros(len(seen), np.uint8)
        cell[seen] = sectors(edges.uv_px.T[seen].astype(np.float64))
        turns = inverse_root(CURVATURE_PX2 * of_all[: len(TURNS), : len(TURNS)])
        return cls(edges, at, list(places), of_all, turns, cell)

    def distance(self, mean: Vector, factor: NDArray[np.float64]) -> float:
        """How far a mean (13,) is from here, in standard deviations of a covariance with this factor (n, n)."""
        off = (mean - self.at)[self.free]
        return sqrt(max(float(np.sum(off * linalg.cholesky_solve(factor, off[:, None])[:, 0])), 0.0))

    def sample(self, mean: Vector, factor: NDArray[np.float64], directions: NDArray[np.float64]) -> _Sample:
        """Across the Gaussian about `mean` (13,), along orthogonal directions (n, n) in its rows."""
        n, offset = len(self.free), (mean - self.at)[self.free]
        along = linalg.product(directions, factor.T)
        rms_px = np.sqrt(np.maximum(linalg.squared(self.metric[None], along), 0.0))
        reach = np.maximum(SPAN, LEAST_SPAN_PX / np.maximum(rms_px, 1e-9))
        offsets = reach[:, None] * along
        points = offset + np.concatenate([offsets, -offsets])
        z, slopes = self.edges.gradients_at(points)
        z = np.maximum(z, 0.0)
        slopes = z[:, None] * slopes
        differences = (slopes[n:] - slopes[:n]) / (2.0 * reach)[:, None]
        along_directions = linalg.product(differences, factor)
        curvature = linalg.product(directions.T, along_directions)
        of_directions = np.einsum("ki,ki->k", along_directions, directions)
        tops = 0.25 * (z[:n] ** 2 + z[n:] ** 2) + 0.5 * reach**2 * of_directions
        gradient = linalg.product(factor.T, slopes.mean(axis=0)[:, None])[:, 0]
        curvature = 0.5 * (curvature + curvature.T)
        return _Sample(gradient, curvature, float(tops.mean()), points[0], float(z[0]))


class _Scatter:
    """κ from the curvature of z²/2 along turns and the scatter of its gradient, as they are averaged."""

    def __init__(self, share: float, known: bool) -> None:
        self.share = share
        self._known = known
        self._curvature = 0.0
        self._scatter = np.zeros(2)
        self._added = 0

    def add(self, local: _Local, sample: _Sample, factor: NDArray[np.float64], rate: float) -> None:
        """Adds a sample of a Gaussian whose covariance has this factor (n, n)."""
        if self._known:
            return
        turns = np.zeros((len(local.free), len(TURNS)))
        turns[: len(TURNS)] = local.turns
        inside = linalg.product(factor.T, linalg.cholesky_solve(factor, turns))
        curvature = float(np.sum(linalg.squared(sample.curvature[None], inside.T)))
        slopes = local.edges.gradients_of_cells(local.cell, COLUMNS * ROWS, sample.point, len(TURNS))
        slopes = sample.of_point * np.einsum("nfb,nk->kfb", slopes, local.turns)
        scatter = np.array([_scatter(slopes.sum(axis=axis)) for axis in (2, 1)])
        self._curvature += rate * (curvature - self._curvature)
        self._scatter += rate * (scatter - self._scatter)
        self._added += 1
        if self._added > 2:
            inflation = self._scatter / max(self._curvature, LEAST_SQUARE)
            groups = np.array(slopes.shape[1:])
            shrunk = (groups * inflation + TYPICAL_GROUPS / TYPICAL_SHARE) / (groups + TYPICAL_GROUPS)
            self.share = min(max(1.0 / float(shrunk.max(where=groups >= FEWEST, initial=1.0)), LEAST_SHARE), 1.0)

    def check(self) -> None:
        """Raises ValueError if the samples do not show how independent the edges are."""
        if not self._known and not (self._curvature > 0.0 and self._scatter.max() > 0.0):
            raise ValueError("the edges in view do not determine how independent they are")


def _scatter(slopes: NDArray[np.float64]) -> float:
    """The variance of a sum of m groups that are independent, from the groups (n, m), added up over n; 0 if there are
    too few groups."""
    count = slopes.shape[1]
    if count < FEWEST:
        return 0.0
    centred = slopes - slopes.mean(axis=1)[:, None]
    return float(np.sum(centred * centred) * count / (count - 1))


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


@lru_cache(maxsize=2 * PRECISE)
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
