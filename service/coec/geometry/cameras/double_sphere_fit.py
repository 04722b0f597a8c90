"""The double sphere camera closest to any other camera, with the residual in pixels that is left."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import double_sphere
from coec.geometry.cameras.double_sphere import MAX_XI, MIN_XI, DoubleSphere
from coec.geometry.cameras.registry import Camera
from coec.geometry.projection import project, unproject

# Parameters of the model: with fewer rays than this there is nothing to fit.
_PARAMETERS = 6

# The image is compared at the centres of this many columns and rows of equal cells: the six parameters of a smooth
# function need far fewer. The largest residual is sought on as many pixels along each border, too.
_GRID = 64

# Starts (xi, alpha): the pinhole, then around the values of real lenses (xi of -0.3 to 0.1, alpha of 0.5 to 0.7) and
# the far end of xi. To first order, focal length and alpha can undo a change of xi, so that xi = 0 is always
# stationary, possibly as a saddle. Therefore no start lies on it except the pinhole, which is exact there.
_STARTS = ((0.0, 0.0), (-0.25, 0.55), (-0.6, 0.4), (0.25, 0.5), (0.5, 0.65), (0.9, 0.2))

_MAX_ITERATIONS = 100
# Step of the central difference in xi and alpha: cube root of the float64 epsilon, balancing truncation and rounding.
_DIFFERENCE_STEP = 6e-6
# A step in xi and alpha shorter than this moves no pixel by 1e-8 of a pixel.
_STEP_TOLERANCE = 1e-13
# A root mean square residual below this is rounding: the source is a double sphere. Unit: px.
_EXACT_PX = 1e-10
_MIN_DAMPING, _MAX_DAMPING = 1e-12, 1e12


class Residual(NamedTuple):
    """What separates a camera from the one that it stands for.

    rms_px: distance between the source's pixel and the fitted camera's for the same ray, over the `pixels` compared
    that both cameras see. max_px: the largest on these and along the border of the image. coverage: share of the pixels
    compared that the fitted camera sees, of those that the source sees; below 1 it cannot see to the edge of the
    source.
    """

    rms_px: float
    max_px: float
    pixels: int
    coverage: float


class DoubleSphereFit(NamedTuple):
    """The fitted camera, and the figures of its `Residual` to the source."""

    camera: DoubleSphere
    residual_rms_px: float
    residual_max_px: float
    pixels: int
    coverage: float


def fit_double_sphere(camera: Camera) -> DoubleSphereFit:
    """Least squares of the reprojection error over the source's image, equally weighted in pixels. Deterministic.

    fx, fy, cx, cy enter linearly: for each xi and alpha the best ones are found in closed form (variable projection,
    Golub and Pereyra 1973), so Levenberg-Marquardt runs over xi and alpha alone, from several starts. Raises ValueError
    if the source sees fewer than six of the pixels compared.
    """
    uv_px, rays = _seen(camera, _cell_centres_px(camera))
    if len(uv_px) < _PARAMETERS:
        raise ValueError(f"only {len(uv_px)} pixels of the camera have a ray: too few to fit a model")
    problem = _Problem(camera.width, camera.height, uv_px, rays)
    _, xi, alpha = min(_descend(problem, np.array(start)) for start in _STARTS)
    fitted = problem.camera(xi, alpha)
    return DoubleSphereFit(fitted, *residual(camera, fitted))


def residual(camera: Camera, fitted: Camera) -> Residual:
    """By how much `fitted` misses `camera` over its image, each part of it weighted equally.

    Raises ValueError if no pixel compared is seen by both.
    """
    error_px, valid = _errors_px(fitted, *_seen(camera, _cell_centres_px(camera)))
    if len(error_px) == 0:
        raise ValueError("the two cameras have no pixel in common")
    border_error_px, _ = _errors_px(fitted, *_seen(camera, _border_px(camera)))
    return Residual(
        float(np.sqrt(np.mean(error_px**2))),
        float(np.concatenate([error_px, border_error_px]).max()),
        len(error_px),
        float(valid.mean()),
    )


def _cell_centres_px(camera: Camera) -> NDArray[np.float64]:
    """(N, 2): the image in equal cells, so that every part of it has the same weight."""
    fraction = (np.arange(_GRID) + 0.5) / _GRID
    u, v = np.meshgrid(fraction * camera.width - 0.5, fraction * camera.height - 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


def _border_px(camera: Camera) -> NDArray[np.float64]:
    """(N, 2): along the outermost pixels, corners included."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    u, v = np.linspace(0.0, right, _GRID), np.linspace(0.0, bottom, _GRID)
    zero = np.zeros(_GRID)
    return np.concatenate(
        [np.stack(side, axis=1) for side in ((u, zero), (u, zero + bottom), (zero, v), (zero + right, v))]
    )


def _seen(camera: Camera, uv_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Those of the pixels (N, 2) that have a ray, and their rays (N, 3)."""
    rays, valid = unproject(camera, uv_px)
    return uv_px[valid], rays[valid]


def _errors_px(
    camera: Camera, uv_px: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Reprojection error of the rays that the camera sees, and which of them it sees."""
    projected_px, valid = project(camera, rays)
    return np.linalg.norm(projected_px - uv_px, axis=1)[valid], valid


class _Problem(NamedTuple):
    """Residuals as a function of xi and alpha, with the other four parameters at their best."""

    width: int
    height: int
    uv_px: NDArray[np.float64]
    rays: NDArray[np.float64]

    def _linear(self, xi: float, alpha: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normalised image coordinates (N, 2), and rows (fx, cx) and (fy, cy) of the best line from them to pixels."""
        normalised = double_sphere.build(
            width=self.width, height=self.height, fx=1.0, fy=1.0, cx=0.0, cy=0.0, xi=xi, alpha=alpha
        )
        m, valid = project(normalised, self.rays)
        if np.count_nonzero(valid) < _PARAMETERS:  # xi near -1 sees next to nothing: all rays count as wrong
            return m, np.zeros((2, 2))
        seen_m, seen_uv = (m, self.uv_px) if valid.all() else (m[valid], self.uv_px[valid])
        mean_m, mean_uv = seen_m.mean(axis=0), seen_uv.mean(axis=0)
        centred = seen_m - mean_m
        focal = (centred * (seen_uv - mean_uv)).sum(axis=0) / (centred**2).sum(axis=0)
        return m, np.stack([focal, mean_uv - focal * mean_m], axis=1)

    def residuals(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2N,) pixels. A ray beyond the camera's domain lands on the principal point: wrong by its whole radius."""
        m, line = self._linear(float(parameters[0]), float(parameters[1]))
        return (m * line[:, 0] + line[:, 1] - self.uv_px).ravel()

    def camera(self, xi: float, alpha: float) -> DoubleSphere:
        """The double sphere with these xi and alpha and the best fx, fy, cx, cy."""
        _, ((fx, cx), (fy, cy)) = self._linear(xi, alpha)
        return double_sphere.build(width=self.width, height=self.height, fx=fx, fy=fy, cx=cx, cy=cy, xi=xi, alpha=alpha)


_LOWER, _UPPER = np.array([MIN_XI, 0.0]), np.array([MAX_XI, 1.0])


def _jacobian(problem: _Problem, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2N, 2) by central differences, one-sided at a bound."""
    columns = []
    for step in np.diag([_DIFFERENCE_STEP, _DIFFERENCE_STEP]):
        ahead = np.clip(parameters + step, _LOWER, _UPPER)
        behind = np.clip(parameters - step, _LOWER, _UPPER)
        change = problem.residuals(ahead) - problem.residuals(behind)
        columns.append(change / (ahead - behind).sum())
    return np.stack(columns, axis=1)


def _descend(problem: _Problem, parameters: NDArray[np.float64]) -> tuple[float, float, float]:
    """Levenberg-Marquardt (Marquardt 1963) inside the bounds. Returns the sum of squares, xi and alpha."""
    residuals = problem.residuals(parameters)
    cost = float(residuals @ residuals)
    damping = 1e-3
    for _ in range(_MAX_ITERATIONS):
        if cost <= _EXACT_PX**2 * len(problem.rays):
            break
        jacobian = _jacobian(problem, parameters)
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ residuals
        # A parameter that the gradient pushes against its bound stays there.
        free = ~(((parameters <= _LOWER) & (gradient > 0.0)) | ((parameters >= _UPPER) & (gradient < 0.0)))
        improved = False
        while free.any() and damping < _MAX_DAMPING:
            damped = normal + damping * np.diag(normal.diagonal())
            step = np.zeros(2)
            step[free] = -np.linalg.lstsq(damped[np.ix_(free, free)], gradient[free], rcond=None)[0]
            proposed = np.clip(parameters + step, _LOWER, _UPPER)
            proposed_residuals = problem.residuals(proposed)
            proposed_cost = float(proposed_residuals @ proposed_residuals)
            if proposed_cost < cost:
                moved = float(np.abs(proposed - parameters).max())
                parameters, residuals, cost = proposed, proposed_residuals, proposed_cost
                damping = max(damping * 0.1, _MIN_DAMPING)
                improved = moved > _STEP_TOLERANCE
                break
            damping *= 10.0
        if not improved:
            break
    return cost, float(parameters[0]), float(parameters[1])
