"""The camera models by name and by type, functions for cameras of any model, projection of one point and the other way
round, and what a camera sees: which pixels exist, how far from the optical axis points still have a pixel, and the
angle that a pixel covers.
"""

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from coec.geometry import CAMERA_MODELS
from coec.geometry.cameras.base import CameraFields, guarded_pixel, positive
from coec.geometry.points import rows_of


class Camera(CameraFields, Protocol):
    """A camera of any model: the named tuple that the `build` of its module returns."""

    def __iter__(self) -> Iterator[float]: ...
    def __hash__(self) -> int: ...
    def _asdict(self) -> dict[str, Any]: ...
    def _replace(
        self, *, width: int = ..., height: int = ..., fx: float = ..., fy: float = ..., cx: float = ..., cy: float = ...
    ) -> Self: ...


class Model(NamedTuple):
    """The parts of a camera model. The scalar functions also run uncompiled."""

    name: str
    camera_type: type[Camera]
    build: Callable[..., Camera]
    image_point: Callable[..., tuple[float, float, bool]]
    unproject_point: Callable[..., tuple[float, float, float, bool]]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the intrinsics, in order: exactly the arguments of `build`."""
        return tuple(inspect.signature(self.build).parameters)


_MODULES = {name: import_module(f"coec.geometry.cameras.{name}") for name in CAMERA_MODELS}

MODELS: Mapping[str, Model] = MappingProxyType(
    {
        name: Model(
            name, get_type_hints(module.build)["return"], module.build, module.image_point, module.unproject_point
        )
        for name, module in _MODULES.items()
    }
)

HELPERS: tuple[Callable[..., Any], ...] = tuple(
    helper for module in _MODULES.values() for helper in getattr(module, "HELPERS", ())
)
"""Functions of lenses that their formulas call: compiled with them."""

_BY_TYPE: Mapping[type, Model] = MappingProxyType({model.camera_type: model for model in MODELS.values()})


def model_of(camera_type: type) -> Model:
    """The model whose cameras are of this type. Raises TypeError for any other type."""
    try:
        return _BY_TYPE[camera_type]
    except KeyError:
        raise TypeError(f"{camera_type!r} is not the type of a camera") from None


def build(model: str, **intrinsics: float) -> Camera:
    """A camera from the name of its model and its intrinsics, named as in dataset.yaml.

    Raises ValueError that names the model and what is unknown, missing or out of range.
    """
    if model not in MODELS:
        raise ValueError(f"unknown camera model {model!r}; known: {', '.join(MODELS)}")
    parameters = MODELS[model].parameters
    if unknown := sorted(set(intrinsics) - set(parameters)):
        raise ValueError(f"{model}: unknown intrinsics {', '.join(unknown)}; known: {', '.join(parameters)}")
    if missing := [name for name in parameters if name not in intrinsics]:
        raise ValueError(f"{model}: missing intrinsics {', '.join(missing)}")
    try:
        return MODELS[model].build(**intrinsics)
    except ValueError as error:
        raise ValueError(f"{model}: {error}") from error


def name_of(camera: Camera) -> str:
    """Name of the camera's model, as in dataset.yaml."""
    return model_of(type(camera)).name


def intrinsics_of(camera: Camera) -> dict[str, float | int]:
    """The arguments that `build` makes this camera from: plain numbers, without derived fields."""
    fields = camera._asdict()
    return {name: fields[name] for name in model_of(type(camera)).parameters}


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The camera of a part of the image: `width` columns and `height` rows (above zero, else ValueError) from column
    `left` and row `top` on."""
    part = {"width": width, "height": height, "cx": camera.cx - left, "cy": camera.cy - top}
    return build(name_of(camera), **intrinsics_of(camera) | part)


def scaled(camera: Camera, scale_x: float, scale_y: float) -> Camera:
    """The camera of an image that was resized by these factors (above zero, else ValueError).

    Pixel centres are integers, so u' = (u + 0.5) scale_x - 0.5; width and height are rounded to whole pixels.
    """
    scale_x = positive("scale_x", scale_x)
    scale_y = positive("scale_y", scale_y)
    return build(
        name_of(camera),
        **intrinsics_of(camera)
        | {
            "width": max(1, round(camera.width * scale_x)),
            "height": max(1, round(camera.height * scale_y)),
            "fx": camera.fx * scale_x,
            "fy": camera.fy * scale_y,
            "cx": (camera.cx + 0.5) * scale_x - 0.5,
            "cy": (camera.cy + 0.5) * scale_y - 0.5,
        },
    )


def project_point(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, valid): pixel of a point (m) of the camera frame. An invalid point gets a finite pixel and False.

    NaN and infinity are invalid. A valid point need not lie in the image.
    """
    u, v, in_domain = image_point(camera, x, y, z)
    return guarded_pixel(camera, x, y, z, u, v, in_domain)


def image_point(camera: Camera, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, in_domain): the model's formula alone. Outside its domain, and for what is no point (NaN, infinity, the
    origin), u and v are anything.

    Compiled for the precision of the point, which must be that of the camera's fields: see `base.like`.
    """
    return model_of(type(camera)).image_point(camera, x, y, z)


def unproject_point(camera: Camera, u: float, v: float) -> tuple[float, float, float, bool]:
    """(x, y, z, valid): unit ray of a pixel in the camera frame. An invalid pixel gets the optical axis and False."""
    return model_of(type(camera)).unproject_point(camera, u, v)


_STEP = 1e-3
"""Step in radians that is small enough for every camera model to be linear."""


def in_image(camera: Camera, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(N,): true where the nearest pixel exists: -0.5 <= u < width - 0.5, and v likewise. uv_px: (N, 2)."""
    u, v = rows_of("uv_px", uv_px, 2).T
    inside: NDArray[np.bool_] = (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return inside


@lru_cache(maxsize=64, typed=True)
def in_single_precision(camera: Camera) -> Camera:
    """The same camera with intrinsics as float32: in single precision a vector register holds twice as many points."""
    return type(camera)(*(field if isinstance(field, int) else np.float32(field) for field in camera))


def domain_angle_rad(camera: Camera) -> float:
    """The angle from the optical axis, in (0, π], up to which a point has a pixel. In every model the domain is a cone
    about the axis."""
    low, high = 0.0, math.pi
    for angle in np.linspace(0.0, math.pi, 257)[1:].tolist():
        if not project_point(camera, math.sin(angle), 0.0, math.cos(angle))[2]:
            high = angle
            break
        low = angle
    while low < (middle := 0.5 * (low + high)) < high:  # bisection down to the last bit
        if project_point(camera, math.sin(middle), 0.0, math.cos(middle))[2]:
            low = middle
        else:
            high = middle
    return low


def pixel_rad(camera: Camera) -> float:
    """The angle that a pixel on the optical axis covers, radians; the larger one if rows and columns differ. It is
    measured by projection, because the focal length of a fisheye is not in pixels per radian."""
    u, v, _ = project_point(camera, 0.0, 0.0, 1.0)
    neighbours = project_point(camera, _STEP, 0.0, 1.0), project_point(camera, 0.0, _STEP, 1.0)
    return _STEP / min(math.hypot(right - u, down - v) for right, down, _ in neighbours)
