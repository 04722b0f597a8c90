"""Cameras in the form of viewers: `foxglove.CameraCalibration`."""

from __future__ import annotations

from dataclasses import dataclass

from coec.adapters.ros.outgoing import UnsupportedCameraError, ros_camera
from coec.geometry.cameras import Camera, intrinsics_of, name_of


@dataclass(frozen=True, slots=True)
class ViewerCamera:
    """A camera for viewers: their name of its model, its coefficients in their order, and the camera itself, whose
    size, focal lengths and principal point are sent unchanged."""

    camera: Camera
    distortion_model: str
    coefficients: tuple[float, ...]


VIEWER_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "pinhole": ("plumb_bob", ()),
    "radtan": ("plumb_bob", ("k1", "k2", "p1", "p2", "k3")),
    "rational": ("rational_polynomial", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kannala_brandt": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
}
"""The viewers' name of each model, and coec's names of its coefficients in their order. Points on the image do not need
them."""


def viewer_camera(camera: Camera) -> ViewerCamera | None:
    """The camera for viewers. One of a model that they do not know becomes a Kannala-Brandt camera, as for ROS; None if
    that would put points on other pixels."""
    try:
        known, _ = ros_camera(camera)
    except UnsupportedCameraError:
        return None
    model, names = VIEWER_MODELS[name_of(known)]
    values = intrinsics_of(known)
    return ViewerCamera(known, model, tuple(float(values[name]) for name in names) or (0.0,) * 5)
