"""Camera models: one module each, with named intrinsics, the formula, its domain and its source.

A camera is an immutable named tuple, so that compiled code takes it as it is and knows its model at compile time.
Points of the camera frame: x right, y down, z forward, metres. Pixel centres lie at integer coordinates (OpenCV).
"""

from coec.geometry.cameras.registry import (
    MODELS,
    Camera,
    Model,
    build,
    cropped,
    domain_angle_rad,
    image_point,
    in_image,
    in_single_precision,
    intrinsics_of,
    name_of,
    pixel_rad,
    project_point,
    scaled,
    unproject_point,
)

__all__ = [
    "MODELS",
    "Camera",
    "Model",
    "build",
    "cropped",
    "domain_angle_rad",
    "image_point",
    "in_image",
    "in_single_precision",
    "intrinsics_of",
    "name_of",
    "pixel_rad",
    "project_point",
    "scaled",
    "unproject_point",
]
