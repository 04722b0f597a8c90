"""The models by name and by type, and functions for cameras of any model."""

import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from coec.geometry.cameras import double_sphere, eucm, kannala_brandt, mei, pinhole, radtan, rational
from coec.geometry.cameras.double_sphere import DoubleSphere
from coec.geometry.cameras.eucm import Eucm
from coec.geometry.cameras.intrinsics import positive
from coec.geometry.cameras.kannala_brandt import KannalaBrandt
from coec.geometry.cameras.mei import Mei
from coec.geometry.cameras.pinhole import Pinhole
from coec.geometry.cameras.radtan import RadTan
from coec.geometry.cameras.rational import Rational

Camera = Pinhole | RadTan | Rational | KannalaBrandt | Mei | Eucm | DoubleSphere


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


MODELS: Mapping[str, Model] = MappingProxyType(
    {
        name: Model(name, camera_type, module.build, module.image_point, module.unproject_point)
        for name, camera_type, module in (
            ("pinhole", Pinhole, pinhole),
            ("radtan", RadTan, radtan),
            ("rational", Rational, rational),
            ("kannala_brandt", KannalaBrandt, kannala_brandt),
            ("mei", Mei, mei),
            ("eucm", Eucm, eucm),
            ("double_sphere", DoubleSphere, double_sphere),
        )
    }
)

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
