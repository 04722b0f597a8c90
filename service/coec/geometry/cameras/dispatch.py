"""Projection of one point by any camera: callable from compiled loops, where the model is chosen at compile time.

The choice falls on the type of the camera. A kernel therefore needs no branch and no code per model, and numba caches
it on disk, which it does not do for a kernel that takes a function as an argument.
"""

from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import overload

from coec.geometry.cameras.kernel import guarded_pixel
from coec.geometry.cameras.registry import Camera, model_of


def project_point(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, valid): pixel of a point (m) of the camera frame. An invalid point gets a finite pixel and False.

    NaN and infinity are invalid. A valid point need not lie in the image.
    """
    u, v, in_domain = image_point(camera, x, y, z)
    return guarded_pixel(camera, x, y, z, u, v, in_domain)


def image_point(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, in_domain): the model's formula alone. Outside its domain, and for what is no point (NaN, infinity, the
    origin), u and v are anything.

    Compiled for the precision of the point, which must be that of the camera's fields: see `kernel.like`.
    """
    return model_of(type(camera)).image_point(camera, x, y, z)


def unproject_point(camera: Camera, u: float, v: float) -> tuple[float, float, float, bool]:
    """(x, y, z, valid): unit ray of a pixel in the camera frame. An invalid pixel gets the optical axis and False."""
    return model_of(type(camera)).unproject_point(camera, u, v)


# Each formula is compiled with its own options, not with those of the loop around it: NaN stays invalid in a caller
# with fastmath. `strict=False`: the annotations differ between the two signatures, and numba would compare them.
@overload(image_point, jit_options={"error_model": "numpy"}, strict=False)
def _image_point(
    camera: types.NamedTuple,
    x: types.Type,  # noqa: ARG001  (numba matches the names)
    y: types.Type,  # noqa: ARG001
    z: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).image_point


@overload(project_point, jit_options={"error_model": "numpy"}, strict=False)
def _project_point(
    camera: types.NamedTuple,  # noqa: ARG001
    x: types.Type,  # noqa: ARG001
    y: types.Type,  # noqa: ARG001
    z: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    def compiled(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
        u, v, in_domain = image_point(camera, x, y, z)
        return guarded_pixel(camera, x, y, z, u, v, in_domain)

    return compiled


@overload(unproject_point, jit_options={"error_model": "numpy"}, strict=False)
def _unproject_point(
    camera: types.NamedTuple,
    u: types.Type,  # noqa: ARG001
    v: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).unproject_point
