"""What the files of windows, and what is in them, are called."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""Of a window that is being recorded; what is found at start can be salvaged."""

REWRITE_SUFFIX = ".tmp"
"""Of a finished window that is being written again; found at start it is of no use, the original is still there."""

RIG, CONFIGURATION, MASK, RESULT = "rig.json", "configuration.json", "mask.png", "result.json"
"""Attachments."""

JSON = "application/json"

METADATA, KEPT = "coec", "coec_kept"
"""Metadata: what the window is, and of which other window it holds pairs."""

PACKING, LZ4 = "packing", "lz4"
"""Among the metadata: how chunks are compressed that shrink; empty: not at all. Whoever writes the window again does
the same."""

IMAGE, COMPRESSED, DEPTH = "camera/image", "camera/image/compressed", "camera/depth/compressed"
POINTS, CAMERA_INFO, RESULT_TOPIC, OVERLAY = "lidar/points", "camera/camera_info", "result", "overlay"
ODOMETRY, IMU = "odometry", "imu"
"""Topics below `/coec/<pair>/`."""

BETWEEN = "between/"
"""Below it the sweep, ego-motion and image of the thinned pairs, as above."""

BETWEEN_IMAGE = BETWEEN + "image/compressed"
"""Their images are compressed, whatever the camera sends."""


def topic(pair: str, name: str) -> str:
    """One of these, of a pair."""
    return f"/coec/{pair}/{name}"


def is_between(topic: str) -> bool:
    """Whether a topic is one of the thinned pairs. A pair may have any name."""
    return topic.split("/")[3:4] == [BETWEEN.rstrip("/")]


def beside(path: Path, suffix: str) -> Path:
    """The name of a file and this suffix."""
    return path.with_name(path.name + suffix)
