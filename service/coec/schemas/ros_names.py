"""Names under which ROS 2 sees the service: of its node, its topics, its diagnostics and its frames."""

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
    """Of the intrinsics of a pair's camera, beside nobody's images: they are the service's own word of them."""
    return f"/coec/{ros_name(pair)}/camera/camera_info"


def overlay_topic(pair: str) -> str:
    """Of the picture of points on an image. No `camera_info` belongs to it: it has a title and a scale."""
    return f"/coec/{ros_name(pair)}/overlay/compressed"


def sensor_status_name(sensor: str) -> str:
    """Of a sensor among the diagnostics."""
    return f"{NODE}: {sensor}_mount"


def status_name(pair: str) -> str:
    """Of a pair among the diagnostics: `node: name`, as aggregators and Autoware's graph take it apart."""
    return f"{NODE}: {pair}_calibration"
