"""Chooses the transforms for `/tf_static`: the served extrinsics, under frame names that mark them as calibrated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coec.adapters.ros.outgoing import PlacedFrame
from coec.config import RosConfig
from coec.geometry import se3
from coec.schemas.replies import ExtrinsicReply
from coec.schemas.ros_names import ros_name


@dataclass(frozen=True, slots=True)
class Transforms:
    """The transforms of one message, and for each pair a short text: what is published of it, or why nothing is."""

    placed: tuple[PlacedFrame, ...]
    texts: dict[str, str]


class CalibratedFrames:
    """Each camera's calibrated frame, as a child of its LiDAR's frame. In tf a transform is the pose of the child in
    the parent, so it is the inverse of T_camera_lidar.

    A calibrated frame is published only once something else than the nominal calibration is served; the vehicle's own
    tree has the nominal one. A published transform stays in the buffers of its subscribers. Therefore the frame stays
    published after a reset to nominal, and follows what is served.
    """

    def __init__(self, ros: RosConfig) -> None:
        self._ros = ros
        self._published: set[str] = set()

    def transforms(self, served: Sequence[ExtrinsicReply]) -> Transforms:
        """The transforms for what is served of all pairs."""
        cameras = Counter(_frame(extrinsic.camera_frame) for extrinsic in served)
        placed, texts = [], {}
        for extrinsic in served:
            camera, lidar = _frame(extrinsic.camera_frame), _frame(extrinsic.lidar_frame)
            child = self._child(extrinsic.pair, camera, shared=cameras[camera] > 1)
            if child is None:
                texts[extrinsic.pair] = (
                    f"not published: {camera} is the camera of several pairs, and a frame has one parent"
                )
            elif child == lidar:
                texts[extrinsic.pair] = f"not published: {child} is the frame of the LiDAR, too"
            elif not self._is_due(extrinsic):
                texts[extrinsic.pair] = "not published: nominal still"
            else:
                self._published.add(extrinsic.pair)
                T_camera_lidar = np.array(extrinsic.camera_from_lidar.matrix)
                placed.append(PlacedFrame(lidar, child, se3.inverse(T_camera_lidar)))
                texts[extrinsic.pair] = f"{child} in {lidar}, {extrinsic.provenance}"
        return Transforms(tuple(placed), texts)

    def _is_due(self, extrinsic: ExtrinsicReply) -> bool:
        return self._ros.replace_camera_frames or extrinsic.provenance != "nominal" or extrinsic.pair in self._published

    def _child(self, pair: str, camera: str, *, shared: bool) -> str | None:
        """Name of the frame to publish; None if every possible one has another parent already."""
        if self._ros.replace_camera_frames:
            return None if shared else camera
        own = f"{camera}_{ros_name(pair)}" if shared else camera
        return f"{own}{self._ros.calibrated_suffix}"


def _frame(frame_id: str) -> str:
    """The name as tf2 has it, without the leading slash of ROS 1."""
    return frame_id.lstrip("/")
