"""Names of what a viewer subscribes to: `deploy/foxglove-layout.json` and every other layout count on them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


class Pose(StrEnum):
    """Whose extrinsic points are drawn at, and what its frame is called after."""

    SERVED = "served"
    NOMINAL = "nominal"
    CANDIDATE = "candidate"


IMAGE = "/camera/image"
CALIBRATION = "/camera/calibration"
CLOUD = "/lidar/points"
TRANSFORMS = "/tf"
HEALTH = "/health"
LOG = "/log"

POINTS: Mapping[Pose, str] = {pose: f"/camera/points_{pose}" for pose in Pose}
"""Points on the image, one topic for each extrinsic: each is shown or hidden by itself."""

PICTURES = frozenset({IMAGE, CALIBRATION, CLOUD, TRANSFORMS, *POINTS.values()})
"""What needs the sensors' frames."""

TOPICS: Mapping[str, str] = {
    IMAGE: "the camera's image as it came; raw pixels as JPEG",
    **{topic: f"points of the sweep on the image, at the {pose} extrinsic" for pose, topic in POINTS.items()},
    CLOUD: "the sweep, compensated to the instant of the image",
    TRANSFORMS: "pose of the camera in the LiDAR's frame: a frame for each extrinsic",
    CALIBRATION: "intrinsics, where the camera's model has a counterpart in the viewers",
    HEALTH: "once a second and at every change: state, reasons, figures, ages",
    LOG: "a line for every change of the state",
}
"""All of them, and what each holds."""


def frame_of(camera_frame: str, pose: Pose) -> str:
    """The camera's frame at this extrinsic."""
    return f"{camera_frame}_{pose}"
