"""Projection of one point by any camera, and the other way round: the model is chosen by the type of the camera."""

from coec.geometry.cameras.formulas import guarded_pixel
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

    Compiled for the precision of the point, which must be that of the camera's fields: see `formulas.like`.
    """
    return model_of(type(camera)).image_point(camera, x, y, z)


def unproject_point(camera: Camera, u: float, v: float) -> tuple[float, float, float, bool]:
    """(x, y, z, valid): unit ray of a pixel in the camera frame. An invalid pixel gets the optical axis and False."""
    return model_of(type(camera)).unproject_point(camera, u, v)
