"""Names of window files and of what they contain."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""Suffix of a window that is being recorded. A file with it that is found at start can be salvaged."""

REWRITE_SUFFIX = ".tmp"
"""Suffix of a finished window that is being rewritten. A file with it that is found at start is useless, because the
original is still there."""

RIG, CONFIGURATION, MASK, RESULT = "rig.json", "configuration.json", "mask.png", "result.json"
"""Attachments."""

JSON = "application/json"

METADATA, CARRIED_OVER = "coec", "coec_kept"
"""Metadata records: what the window is, and which other window it holds pairs of."""

PACKING, LZ4 = "packing", "lz4"
"""Entry of the metadata: compression of the chunks that shrink; empty: none. Rewriting a window keeps it."""

IMAGE, COMPRESSED, DEPTH = "camera/image", "camera/image/compressed", "camera/depth/compressed"
POINTS, CAMERA_INFO, RESULT_TOPIC, OVERLAY = "lidar/points", "camera/camera_info", "result", "overlay"
ODOMETRY, IMU = "odometry", "imu"
"""Topics below `/coec/<pair>/`."""

BETWEEN = "between/"
"""Below it are the topics for sweep, ego-motion and image of the thinned pairs."""

BETWEEN_IMAGE = BETWEEN + "image/compressed"
"""The images of thinned pairs are compressed, whatever the camera sends."""


def topic(pair: str, name: str) -> str:
    """The full topic of a pair for one of these names."""
    return f"/coec/{pair}/{name}"


def is_between(topic: str) -> bool:
    """Whether a topic belongs to the thinned pairs. Only the fourth part counts, as a pair may have any name."""
    return topic.split("/")[3:4] == [BETWEEN.rstrip("/")]


def with_suffix(path: Path, suffix: str) -> Path:
    """The path with a suffix added to the file name."""
    return path.with_name(path.name + suffix)
