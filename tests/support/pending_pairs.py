"""A pair that is awaited, what it waits for, and what lies outside of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import Reason
from coec.config import Config
from coec.io.ros import messages
from coec.io.zenoh.bus import CDR, Answer, InputSample
from coec.io.zenoh.ros_node import RosTopicList
from coec.schemas.keys import Keys
from coec.service.discovery_listener import NominalStatus
from coec.service.vehicle_context import VehicleContext
from support.recordings import STORE, camera_info_message, transform_message
from support.ros import compressed_image, packed_cloud
from support.vehicles import InstantDiskWriter

CAMERA, POINTS, INFO, TF_STATIC = "/front/image/compressed", "/top/points", "/front/camera_info", "/tf_static"

T_CAMERA_LIDAR = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def configured(folder: Path, **given: object) -> Config:
    """A vehicle with one pair, of which nothing is known but its topics and what is `given`."""
    pair = {"name": "front", "camera": CAMERA, "points": POINTS, **given}
    state = {"directory": folder, "min_free_bytes": 0}
    return Config.model_validate({"middleware": "rmw_zenoh", "state": state, "pairs": [pair]})


def _cdr(payload: bytes, type_name: str) -> InputSample:
    return InputSample(payload, f"{CDR};{type_name}")


def _transforms() -> bytes:
    message = ros.tf2_msgs__msg__TFMessage([transform_message("camera", "lidar", T_CAMERA_LIDAR)])
    return bytes(STORE.serialize_cdr(message, messages.TF))


XYZ: Any = [(axis, "<f4", [1.0, 2.0]) for axis in "xyz"]

SAMPLES = {
    CAMERA: _cdr(compressed_image(), messages.COMPRESSED_IMAGE),
    POINTS: _cdr(packed_cloud(XYZ), messages.POINT_CLOUD),
    INFO: _cdr(messages.serialized(camera_info_message("plumb_bob", []), messages.CAMERA_INFO), messages.CAMERA_INFO),
    TF_STATIC: _cdr(_transforms(), messages.TF),
}
"""By topic, what tells all that the configuration leaves out."""


class World:
    """What lies outside, as a test says it; the rest of it is asked by nobody who waits.

    Attributes:
        published: keys and answers, in the order in which they were published.
    """

    def __init__(self, folder: Path, nominal: Callable[[str], NominalStatus]) -> None:
        self.published: list[tuple[str, Answer]] = []
        self.problems: tuple[Reason, ...] = ()
        self.topics = RosTopicList()
        nothing = cast("Any", None)
        self.context = VehicleContext(
            Keys("coec", "vehicle"),
            nothing,
            nothing,
            InstantDiskWriter(folder),
            nothing,
            nothing,
            nothing,
            lambda key, answer: self.published.append((key, answer)),
            lambda: self.problems,
            lambda *_: None,
            lambda: self.topics,
            nominal,
        )
