"""Which transforms are told on `/tf_static`: what is served, under names that say what it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coec.adapters.ros.outgoing import Placed
from coec.config import RosConfig
from coec.geometry import se3
from coec.schemas.replies import ExtrinsicReply
from coec.schemas.ros_names import ros_name


@dataclass(frozen=True, slots=True)
class Transforms:
    """Those to tell, all of one message, and of each pair in a word what is told, or why nothing is."""

    placed: tuple[Placed, ...]
    words: dict[str, str]


class CalibratedFrames:
    """Each camera's calibrated frame, a child of its LiDAR's: of tf a transform is the pose of the child in the parent,
    the inverse of T_camera_lidar.

    A frame is called calibrated only once something but the nominal calibration is served: until then nobody finds it,
    and the vehicle's own tree has the nominal one. What was told once stays in the buffers of whoever heard it: after a
    reset to nominal the frame therefore follows what is served.
    """

    def __init__(self, ros: RosConfig) -> None:
        self._ros = ros
        self._told: set[str] = set()

    def transforms(self, served: Sequence[ExtrinsicReply]) -> Transforms:
        """Of what is served of all pairs."""
        cameras = Counter(_frame(extrinsic.camera_frame) for extrinsic in served)
        placed, words = [], {}
        for extrinsic in served:
            camera, lidar = _frame(extrinsic.camera_frame), _frame(extrinsic.lidar_frame)
            child = self._child(extrinsic.pair, camera, shared=cameras[camera] > 1)
            if child is None:
                words[extrinsic.pair] = f"not published: {camera} is the camera of several pairs, and has one parent"
            elif child == lidar:
                words[extrinsic.pair] = f"not published: {child} is the frame of the LiDAR, too"
            elif not self._is_due(extrinsic):
                words[extrinsic.pair] = "not published: nominal still"
            else:
                self._told.add(extrinsic.pair)
                T_camera_lidar = np.array(extrinsic.camera_from_lidar.matrix)
                placed.append(Placed(lidar, child, se3.inverse(T_camera_lidar)))
                words[extrinsic.pair] = f"{child} in {lidar}, {extrinsic.provenance}"
        return Transforms(tuple(placed), words)

    def _is_due(self, extrinsic: ExtrinsicReply) -> bool:
        return self._ros.replace_camera_frames or extrinsic.provenance != "nominal" or extrinsic.pair in self._told

    def _child(self, pair: str, camera: str, *, shared: bool) -> str | None:
        """Name of the frame that is told; None where there is none that has no other parent."""
        if self._ros.replace_camera_frames:
            return None if shared else camera
        own = f"{camera}_{ros_name(pair)}" if shared else camera
        return f"{own}{self._ros.calibrated_suffix}"


def _frame(frame_id: str) -> str:
    """As tf2 has it: without the slash that ROS 1 began with."""
    return frame_id.lstrip("/")
