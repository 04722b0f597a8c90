"""Projection of one point by any camera: callable from compiled loops, where the model is chosen at compile time.

The choice falls on the type of the camera. A kernel therefore needs no branch and no code per model, and numba caches
it on disk, which it does not do for a kernel that takes a function as an argument.
"""

from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import overload

from coec.geometry.cameras.registry import Camera, model_of


def project_point(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, valid): pixel of a point (m) of the camera frame. An invalid point gets a finite pixel and False.

    NaN and infinity are invalid. A valid point need not lie in the image.
    """
    return model_of(type(camera)).project_point(camera, x, y, z)


def unproject_point(camera: Camera, u: float, v: float) -> tuple[float, float, float, bool]:
    """(x, y, z, valid): unit ray of a pixel in the camera frame. An invalid pixel gets the optical axis and False."""
    return model_of(type(camera)).unproject_point(camera, u, v)


# Each formula is compiled with its own options, not with those of the loop around it: NaN stays invalid in a caller
# with fastmath. `strict=False`: the annotations differ between the two signatures, and numba would compare them.
@overload(project_point, jit_options={"error_model": "numpy"}, strict=False)
def _project_point(
    camera: types.NamedTuple,
    x: types.Type,  # noqa: ARG001  (numba matches the names)
    y: types.Type,  # noqa: ARG001
    z: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).project_point


@overload(unproject_point, jit_options={"error_model": "numpy"}, strict=False)
def _unproject_point(
    camera: types.NamedTuple,
    u: types.Type,  # noqa: ARG001
    v: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).unproject_point
