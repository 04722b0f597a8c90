"""Names of the topics for viewers; `deploy/foxglove-layout.json` and all other layouts depend on them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from coec.adapters.foxglove.intrinsics import viewer_camera
from coec.geometry.cameras import Camera


class DisplayedPose(StrEnum):
    """Which extrinsic is drawn; also the suffix of its frame's name."""

    SERVED = "served"
    NOMINAL = "nominal"
    CANDIDATE = "candidate"


IMAGE_TOPIC = "/camera/image"
CALIBRATION_TOPIC = "/camera/calibration"
CLOUD_TOPIC = "/lidar/points"
TRANSFORMS_TOPIC = "/tf"
HEALTH_TOPIC = "/health"
LOG_TOPIC = "/log"

POINTS_TOPICS: Mapping[DisplayedPose, str] = {pose: f"/camera/points_{pose}" for pose in DisplayedPose}
"""Topics of the points on the image, one per extrinsic, so that each can be shown or hidden separately."""

PICTURE_TOPICS = frozenset({IMAGE_TOPIC, CALIBRATION_TOPIC, CLOUD_TOPIC, TRANSFORMS_TOPIC, *POINTS_TOPICS.values()})
"""Topics that need the sensors' frames."""

TOPIC_DESCRIPTIONS: Mapping[str, str] = {
    IMAGE_TOPIC: "the camera's image as it came; raw pixels as JPEG",
    **{topic: f"points of the sweep on the image, at the {pose} extrinsic" for pose, topic in POINTS_TOPICS.items()},
    CLOUD_TOPIC: "the sweep, compensated to the instant of the image",
    TRANSFORMS_TOPIC: "pose of the camera in the LiDAR's frame: a frame for each extrinsic",
    CALIBRATION_TOPIC: "intrinsics, in a model that viewers know; absent if none puts the points on the same pixels",
    HEALTH_TOPIC: "once a second and at every change: state, reasons, figures, ages",
    LOG_TOPIC: "a line for every change of the state",
}
"""All topics and what each holds."""


def topics_for(camera: Camera) -> Mapping[str, str]:
    """The topics of a pair with this camera: all but `CALIBRATION`, if viewers have no model for it. A topic on which
    nothing comes is not advertised, because viewers wait for it."""
    if viewer_camera(camera) is not None:
        return TOPIC_DESCRIPTIONS
    return {topic: held for topic, held in TOPIC_DESCRIPTIONS.items() if topic != CALIBRATION_TOPIC}


def frame_of(camera_frame: str, pose: DisplayedPose) -> str:
    """The camera's frame at this extrinsic."""
    return f"{camera_frame}_{pose}"
