"""Registers the formulas of the camera models with numba. Import `coec.geometry.compiler`, which imports this module.

The model is chosen at compile time, by the type of the camera. A kernel therefore needs no branch and no code per
model, and numba caches it on disk, which it does not do for a kernel that takes a function as an argument.

None of them uses fastmath. numba compiles a parallel kernel twice: for the process that first runs it, and for the
cache. If it may re-associate and fuse, the two differ in the last bit, but decisions have to replay to the byte. The
loops vectorise anyway. (The one exception, `pixel_lookup.certain_pixels`, compiles these formulas for itself and
answers only where the last bits do not matter.)
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload, register_jitable

from coec.geometry.cameras.brown_conrady import distort, undistort
from coec.geometry.cameras.dispatch import image_point, project_point, unproject_point
from coec.geometry.cameras.formulas import arc_over_tangent, guarded_pixel, guarded_ray, like, polar_angle
from coec.geometry.cameras.polynomial import odd_polynomial, solve_odd_polynomial
from coec.geometry.cameras.rational import rational_distort, rational_factor, rational_radius, rational_slope
from coec.geometry.cameras.registry import model_of

# A division by zero gives an infinity, not a branch to an exception. The formulas have options of their own instead of
# their caller's, so that NaN stays invalid in a caller with fastmath.
_OPTIONS: Any = {"error_model": "numpy"}

for _formula in (
    distort, guarded_pixel, guarded_ray, odd_polynomial, polar_angle, project_point, rational_distort, rational_factor,
    rational_radius, rational_slope, solve_odd_polynomial, undistort,
):  # fmt: skip
    register_jitable(**_OPTIONS)(_formula)


# `strict=False`: the annotations differ between the two signatures, and numba would compare them.
@overload(image_point, jit_options=_OPTIONS, strict=False)
def _image_point(
    camera: types.NamedTuple,
    x: types.Type,  # noqa: ARG001  (numba matches the names)
    y: types.Type,  # noqa: ARG001
    z: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).image_point


@overload(unproject_point, jit_options=_OPTIONS, strict=False)
def _unproject_point(
    camera: types.NamedTuple,
    u: types.Type,  # noqa: ARG001
    v: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).unproject_point


@overload(like, strict=False)
def _like(constant: types.Type, value: types.Type) -> Callable[..., Any]:  # noqa: ARG001
    if value == types.float32:
        return lambda constant, value: np.float32(constant)  # noqa: ARG005
    return lambda constant, value: constant  # noqa: ARG005


# As `arc_over_tangent`, from five Chebyshev nodes. Largest error 7e-9, below the rounding of a float32.
_S0, _S1, _S2, _S3, _S4 = (
    np.float32(c)
    for c in (0.9999999812646112, -0.3333278577192708, 0.19974082415558878, -0.13848490212710987, 0.07976291808000396)
)


def _arc_over_tangent_single(s: np.float32) -> np.float32:
    return _S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * _S4)))


@overload(arc_over_tangent, jit_options=_OPTIONS, strict=False)
def _arc_over_tangent(s: types.Type) -> Callable[..., Any]:
    return _arc_over_tangent_single if s == types.float32 else arc_over_tangent
