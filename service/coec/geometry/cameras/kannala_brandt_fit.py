"""The Kannala-Brandt camera closest to any other camera, with the residual in pixels that is left.

For programs that know no other wide lens (ROS's `equidistant`). It is plain Python, because the process that serves
queries has no compiler and a few hundred rays need none.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import kannala_brandt
from coec.geometry.cameras.base import polar_angle
from coec.geometry.cameras.kannala_brandt import KannalaBrandt
from coec.geometry.cameras.registry import Camera, project_point, unproject_point

# theta, theta^3 ... theta^9: as many as the model has coefficients, with the focal length. Two more for the centre.
_POWERS = (1, 3, 5, 7, 9)
_PARAMETERS = len(_POWERS) + 2

# The image is compared at this many columns and rows of pixels, evenly from border to border. Corners are included,
# because a wide lens has its largest residual there. The residual is that of a polynomial of ninth degree against a
# smooth function.
_GRID = 33


class KannalaBrandtFit(NamedTuple):
    """The fitted camera and what separates it from its source.

    residual_rms_px, residual_max_px: distance between the source's pixel and the fitted camera's for the same ray, over
    the pixels compared that the source sees; infinite where the fitted camera does not see all of them.
    """

    camera: KannalaBrandt
    residual_rms_px: float
    residual_max_px: float


def fit_kannala_brandt(camera: Camera) -> KannalaBrandtFit:
    """Least squares of the reprojection error over the source's image. Deterministic.

    With the ratio of the focal lengths kept, u and v are linear in the focal length times each coefficient and in the
    principal point: one linear problem. The fitted focal length is that of the axis, which is not the source's.

    Raises ValueError if the source sees too few of the pixels compared, or no camera of the model comes near it.
    """
    uv_px, rays = _seen(camera)
    if len(uv_px) < _PARAMETERS:
        raise ValueError(f"the camera sees only {len(uv_px)} of its pixels: nothing to fit to")
    theta, sides = _polar(rays)
    powers = theta[:, None] ** np.array(_POWERS)
    focal = np.array([camera.fx, camera.fy])
    # (N, 2, 5) and a column for each of cx and cy: rows of u and of v, one below the other.
    radial = (focal * sides)[:, :, None] * powers[:, None, :]
    centre = np.broadcast_to(np.eye(2), (len(theta), 2, 2))
    design = np.concatenate([radial, centre], axis=2).reshape(-1, _PARAMETERS)
    # Columns differ by powers of theta: scale them to unit length, so that the small ones are not rounded off.
    scale = np.linalg.norm(design, axis=0)
    solution = np.linalg.lstsq(design / scale, uv_px.reshape(-1), rcond=None)[0] / scale
    first, *higher = (float(value) for value in solution[: len(_POWERS)])
    if not first > 0.0:
        raise ValueError("no Kannala-Brandt camera comes near this one")
    k1, k2, k3, k4 = (value / first for value in higher)
    fitted = kannala_brandt.build(
        width=camera.width,
        height=camera.height,
        fx=camera.fx * first,
        fy=camera.fy * first,
        cx=float(solution[-2]),
        cy=float(solution[-1]),
        k1=k1,
        k2=k2,
        k3=k3,
        k4=k4,
    )
    error_px = _errors_px(fitted, uv_px, rays)
    return KannalaBrandtFit(fitted, float(np.sqrt(np.mean(error_px**2))), float(error_px.max()))


def _seen(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Those of the pixels compared (N, 2) that have a ray, and their rays (N, 3)."""
    columns, rows = (np.linspace(0.0, size - 1.0, _GRID) for size in (camera.width, camera.height))
    # NumPy's numbers divide by zero as compiled code does, to an infinity: outside a domain a formula may.
    with np.errstate(all="ignore"):
        rays = [((u, v), unproject_point(camera, u, v)) for v in rows for u in columns]
    seen = [(uv, (x, y, z)) for uv, (x, y, z, valid) in rays if valid]
    return np.array([uv for uv, _ in seen]).reshape(-1, 2), np.array([ray for _, ray in seen]).reshape(-1, 3)


def _polar(rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle from the optical axis (N,), rad, and the direction (N, 2) in which a ray leaves it."""
    radius = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.array([polar_angle(r, z) for r, z in zip(radius.tolist(), rays[:, 2].tolist(), strict=True)])
    # On the axis every direction is the same: the radius there is zero.
    return theta, rays[:, :2] / np.maximum(radius, np.finfo(np.float64).tiny)[:, None]


def _errors_px(camera: KannalaBrandt, uv_px: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reprojection error (N,) of the rays; infinite where the camera does not see one."""
    projected = [project_point(camera, x, y, z) for x, y, z in rays.tolist()]
    seen = np.array([valid for *_, valid in projected])
    error_px: NDArray[np.float64] = np.linalg.norm(np.array([(u, v) for u, v, _ in projected]) - uv_px, axis=1)
    return np.where(seen, error_px, np.inf)
