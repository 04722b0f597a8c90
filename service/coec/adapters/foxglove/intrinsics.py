"""Cameras in the form of viewers: `foxglove.CameraCalibration`."""

from __future__ import annotations

from dataclasses import dataclass

from coec.geometry.cameras import Camera, intrinsics_of, name_of


@dataclass(frozen=True, slots=True)
class Counterpart:
    """A camera for viewers: their name of its model, its coefficients in their order, and the camera itself, whose
    size, focal lengths and principal point are sent unchanged."""

    camera: Camera
    distortion_model: str
    coefficients: tuple[float, ...]


COUNTERPARTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "pinhole": ("plumb_bob", ()),
    "radtan": ("plumb_bob", ("k1", "k2", "p1", "p2", "k3")),
    "kannala_brandt": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
}
"""The viewers' name of each model, and coec's names of its coefficients in their order. Points on the image do not need
them."""


def counterpart_of(camera: Camera) -> Counterpart | None:
    """The camera for viewers; None if they do not know its model."""
    found = COUNTERPARTS.get(name_of(camera))
    if found is None:
        return None
    model, names = found
    values = intrinsics_of(camera)
    return Counterpart(camera, model, tuple(float(values[name]) for name in names) or (0.0,) * 5)
