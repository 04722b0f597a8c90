"""Names under which ROS 2 sees the service: its node, its topics, its diagnostics and its frames."""

from __future__ import annotations

import re
from typing import Final

NODE: Final = "coec"

DIAGNOSTICS: Final = "/diagnostics"
TF_STATIC: Final = "/tf_static"


def ros_name(name: str) -> str:
    """A vehicle or a pair as one token of a ROS name: letters, digits and underscores, and no digit first
    (rmw/validate_full_topic_name.h)."""
    token = re.sub(r"[^A-Za-z0-9_]+", "_", name)
    return f"_{token}" if token[:1].isdecimal() else token


def camera_info_topic(pair: str) -> str:
    """Topic of the intrinsics of a pair's camera, as the service knows them. No images are published beside it."""
    return f"/coec/{ros_name(pair)}/camera/camera_info"


def overlay_topic(pair: str) -> str:
    """Topic of the picture of points on an image. It has no `camera_info`, as the picture has a title and a scale."""
    return f"/coec/{ros_name(pair)}/overlay/compressed"


def sensor_status_name(sensor: str) -> str:
    """Name of a sensor's status among the diagnostics."""
    return f"{NODE}: {sensor}_mount"


def status_name(pair: str) -> str:
    """Name of a pair's status among the diagnostics: `node: name`, as aggregators and Autoware's graph parse it."""
    return f"{NODE}: {pair}_calibration"
