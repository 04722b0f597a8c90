"""Names of the topics for viewers; `deploy/foxglove-layout.json` and all other layouts depend on them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from coec.adapters.foxglove.intrinsics import counterpart_of
from coec.geometry.cameras import Camera


class Pose(StrEnum):
    """Which extrinsic is drawn; also the suffix of its frame's name."""

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
"""Topics of the points on the image, one per extrinsic, so that each can be shown or hidden separately."""

PICTURES = frozenset({IMAGE, CALIBRATION, CLOUD, TRANSFORMS, *POINTS.values()})
"""Topics that need the sensors' frames."""

TOPICS: Mapping[str, str] = {
    IMAGE: "the camera's image as it came; raw pixels as JPEG",
    **{topic: f"points of the sweep on the image, at the {pose} extrinsic" for pose, topic in POINTS.items()},
    CLOUD: "the sweep, compensated to the instant of the image",
    TRANSFORMS: "pose of the camera in the LiDAR's frame: a frame for each extrinsic",
    CALIBRATION: "intrinsics, in a model that viewers know; absent if none puts the points on the same pixels",
    HEALTH: "once a second and at every change: state, reasons, figures, ages",
    LOG: "a line for every change of the state",
}
"""All topics and what each holds."""


def topics_for(camera: Camera) -> Mapping[str, str]:
    """The topics of a pair with this camera: all but `CALIBRATION`, if viewers have no model for it. A topic on which
    nothing comes is not advertised, because viewers wait for it."""
    if counterpart_of(camera) is not None:
        return TOPICS
    return {topic: held for topic, held in TOPICS.items() if topic != CALIBRATION}


def frame_of(camera_frame: str, pose: Pose) -> str:
    """The camera's frame at this extrinsic."""
    return f"{camera_frame}_{pose}"
