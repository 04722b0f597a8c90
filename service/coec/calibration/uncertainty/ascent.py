"""Local ascents of the log-posterior of a window over its pose, lens and clocks.

log p(x) = κ·z²(x)/2 - Σ (xᵢ/σᵢ)²/2, with z the significance of the alignment of the edges, κ the share of the range
edges that is independent, and σ the prior of each place of a deviation (see `displaced_edges`).

The edges are linearised in all places and whitened: by how far a place moves them, and by its prior. In these
coordinates the log-posterior is about as curved along each direction, and a quasi-Newton method reaches the maximum in
some twenty steps, also along ridges on which a turn makes up for a principal point.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.uncertainty.displaced_edges import AssumedEdges
from coec.geometry import linalg
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.displaced_alignment import DisplacedEdges
from coec.geometry.points import thinned

Vector = NDArray[np.float64]

CURVATURE_PX2 = 5.0
"""Curvature that is assumed of a log-likelihood per square pixel: makes the first step of an ascent, and the unit of
its coordinates, about a standard deviation."""

MOST_PX = 2.0
"""Longest step of an ascent, root mean square of the edges."""

ROUNDS, ITERATIONS = 2, 40
"""How often an ascent linearises its edges, and its steps each time."""

TOLERANCE, LEADING = 0.02, 0.1
"""An ascent ends with a step below this, in its coordinates, on the sharpest edges and before: a Gaussian is fitted
there (see `gaussian`)."""

METRIC_POINTS = 1_000
"""Most range edges of which a metric is made."""


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Coordinates of some places of a deviation about a point, in which a log-posterior is about as curved along each.

    Attributes:
        at: (13,) the point.
        places: n places in a deviation.
        axes: (n, n) the coordinates' directions, in columns.
        edges: the edges as a function of the places.
        prior: (n,) standard deviations of the places.
        share: of the range edges that is independent.
    """

    at: Vector
    places: tuple[int, ...]
    axes: NDArray[np.float64]
    edges: DisplacedEdges
    prior: Vector
    share: float

    @classmethod
    def about(
        cls, level: AssumedEdges, at: Vector, places: tuple[int, ...], prior: Vector, share: float
    ) -> "Coordinates":
        """The coordinates of some places about a deviation (13,)."""
        edges, of_places = level.at(at, places), prior[list(places)]
        curvature = CURVATURE_PX2 * metric(edges) + np.diag(1.0 / of_places**2)
        axes = inverse_root(curvature)
        return cls(at, places, axes, edges, of_places, share)

    def deviation(self, x: Vector) -> Vector:
        """(13,) that of coordinates x (n,)."""
        whole = self.at.copy()
        whole[list(self.places)] += np.einsum("ij,j->i", self.axes, x)
        return whole

    def log_posterior(self, x: Vector) -> tuple[float, Vector, float]:
        """The log-posterior at x (n,), up to a constant, its gradient (n,), and z."""
        step = np.einsum("ij,j->i", self.axes, x)
        z, slope = self.edges.significance(step)
        off = (self.at[list(self.places)] + step) / self.prior
        value = 0.5 * self.share * max(z, 0.0) ** 2 - 0.5 * float(np.einsum("i,i", off, off))
        of_places = self.share * max(z, 0.0) * slope - off / self.prior
        return value, np.einsum("ij,i->j", self.axes, of_places), z


def metric(edges: DisplacedEdges) -> NDArray[np.float64]:
    """(n, n) mean products of how the parameters of the edges move them, px² per units."""
    some = thinned(len(edges.weight), METRIC_POINTS)
    jacobian, weight, uv_px = edges.jacobian[:, :, some].astype(np.float64), edges.weight[some], edges.uv_px[:, some]
    height, width = edges.maps.shape[1:]
    inside = (uv_px >= 0.0).all(axis=0) & (uv_px < np.array([[width], [height]])).all(axis=0)
    weight = np.where(inside, weight, 0.0).astype(np.float64)
    whole = max(float(weight.sum()), LEAST_SQUARE)
    # Rows in one piece: NumPy then multiplies them in vector registers.
    rows = jacobian.reshape(len(jacobian), -1)
    products = np.einsum("ke,le->kl", (jacobian * weight).reshape(rows.shape), rows) / whole
    return np.asarray(0.5 * (products + products.T))


def inverse_root(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, n) X with X·Xᵀ the inverse of a symmetric matrix. One that is not positive definite is made so: its diagonal
    grows until it is.

    Raises:
        ValueError: a row of it is zero.
    """
    scale = np.sqrt(np.abs(matrix.diagonal()))
    if not (np.isfinite(matrix).all() and (scale > 0.0).all()):
        raise ValueError("the edges in view do not depend on a parameter")
    correlation, more = matrix / scale / scale[:, None], 0.0
    while True:
        try:
            factor = linalg.cholesky(correlation + more * np.eye(len(scale)))
            break
        except ValueError:
            more = max(2.0 * more, 1e-3)
    root = linalg.cholesky_solve(factor, np.eye(len(scale)))  # (L·Lᵀ)⁻¹, of which L is a factor: X = L⁻ᵀ
    return np.asarray(linalg.product(root, factor) / scale[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class Ascent:
    """Where an ascent ended: its deviation (13,), z and log-posterior there."""

    deviation: Vector
    significance: float
    log_posterior: float


def ascent(
    levels: Sequence[AssumedEdges], start: Vector, places: tuple[int, ...], prior: Vector, share: float
) -> Ascent:
    """The local maximum of the log-posterior on the last level; the levels before lead there."""
    at = start
    for level in levels:
        tolerance = TOLERANCE if level is levels[-1] else LEADING
        for _ in range(ROUNDS):
            coordinates = Coordinates.about(level, at, places, prior, share)
            x, value, z = _quasi_newton(coordinates, tolerance)
            at = coordinates.deviation(x)
            if float(np.max(np.abs(x))) < 10.0 * tolerance:
                break
    return Ascent(at, z, value)


LEAST_SLOPE, SHORTER, SHORTENINGS = 1e-4, 0.4, 8
"""Line search by backtracking (Armijo 1966)."""


def _quasi_newton(coordinates: Coordinates, tolerance: float) -> tuple[Vector, float, float]:
    """The maximum (n,) next to the point of some coordinates (Broyden, Fletcher, Goldfarb, Shanno 1970), the
    log-posterior and z there."""
    n = len(coordinates.places)
    x, inverse = np.zeros(n), np.eye(n)
    value, gradient, z = coordinates.log_posterior(x)
    longest = MOST_PX * sqrt(CURVATURE_PX2)
    for _ in range(ITERATIONS):
        step = np.einsum("ij,j->i", inverse, gradient)
        if float(np.einsum("i,i", step, gradient)) <= 0.0:
            inverse = np.eye(n)
            step = gradient.copy()
        length = sqrt(float(np.einsum("i,i", step, step)))
        if length > longest:
            step *= longest / length
        rise = float(np.einsum("i,i", step, gradient))
        for _ in range(SHORTENINGS):
            next_value, next_gradient, next_z = coordinates.log_posterior(x + step)
            if next_value >= value + LEAST_SLOPE * rise:
                break
            step, rise = SHORTER * step, SHORTER * rise
        else:
            break
        change = gradient - next_gradient
        along = float(np.einsum("i,i", step, change))
        if along > 1e-10:
            image = np.einsum("ij,j->i", inverse, change)
            square = (along + float(np.einsum("i,i", change, image))) / along**2
            mixed = step[:, None] * image
            inverse = inverse + square * step[:, None] * step - (mixed + mixed.T) / along
        x, value, gradient, z = x + step, next_value, next_gradient, next_z
        if float(np.max(np.abs(step))) < tolerance:
            break
    return x, value, z
