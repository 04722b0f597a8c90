"""All frames of a recording as one ROS 2 bag (MCAP, profile `ros2`): for other tools, and to read back as a source."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from coec import __version__
from coec.adapters.ros import messages, outgoing
from coec.calibration.frames.motion_compensation import azimuth_offsets_s
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Matrix4, Rig

Frame = CameraFrame | LidarFrame | EgoMotion


def _nothing(_: Frame) -> list[tuple[str, str, bytes]]:
    return []


def write_bag(
    path: Path,
    rig: Rig,
    T_camera_lidar: Matrix4,
    frames: Iterable[Frame],
    heard: Callable[[Frame], None],
    beside: Callable[[Frame], Iterable[tuple[str, str, bytes]]] = _nothing,
) -> None:
    """Writes the frames below `/<pair>/` with the camera info of each image and one `/tf_static`.

    Args:
        T_camera_lidar: (4, 4), what `/tf_static` says.
        frames: in the order in which they are written; depth maps are left out.
        heard: told of each frame.
        beside: further messages (topic, type, CDR) at the stamp of a frame.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start(profile="ros2", library=f"coec/{__version__}")
        topics = _Topics(writer)
        joined: set[str] = set()
        for frame in frames:
            for child, joint in _joints(rig, T_camera_lidar, frame):
                if child not in joined:
                    topics.write("/tf_static", messages.TF, frame.stamp_ns, joint)
                    joined.add(child)
            for topic, type_name, data in _messages(rig, frame):
                topics.write(topic, type_name, frame.stamp_ns, data)
            for topic, type_name, data in beside(frame):
                topics.write(topic, type_name, frame.stamp_ns, data)
            heard(frame)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves the result open


class _Topics:
    """Registers a channel and its schema at the first message."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence = 0

    def write(self, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        """Adds a message."""
        if topic not in self._channels:
            if type_name not in self._schemas:
                definition = messages.definition(type_name).encode()
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_name])
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, self._sequence)
        self._sequence += 1


def _joints(rig: Rig, T_camera_lidar: Matrix4, frame: Frame) -> list[tuple[str, bytes]]:
    """The static transforms that a frame needs, by the name of their child."""
    joints = [(rig.lidar_frame, outgoing.encode_tf_static(rig, T_camera_lidar, frame.stamp_ns))]
    if isinstance(frame, EgoMotion) and frame.frame_id != rig.lidar_frame:
        # The ego frame as a child of the LiDAR's, written by the same rule: child to parent.
        below = replace(rig, camera_frame=rig.lidar_frame, lidar_frame=frame.frame_id)
        joints.append((frame.frame_id, outgoing.encode_tf_static(below, rig.T_lidar_ego, frame.stamp_ns)))
    return joints


def _messages(rig: Rig, frame: Frame) -> list[tuple[str, str, bytes]]:
    match frame:
        case CameraFrame():
            type_name, data = outgoing.encode_image(frame)
            topic = f"/{rig.pair}/camera/image" + ("/compressed" if type_name == messages.COMPRESSED_IMAGE else "")
            info = outgoing.encode_camera_info(rig, frame.stamp_ns)
            return [(f"/{rig.pair}/camera/camera_info", messages.CAMERA_INFO, info), (topic, type_name, data)]
        case LidarFrame():
            return [(f"/{rig.pair}/lidar/points", messages.POINT_CLOUD, outgoing.encode_cloud(_timed(rig, frame)))]
        case EgoMotion():
            type_name, data = outgoing.encode_motion(frame)
            return [(f"/{rig.pair}/{'imu' if type_name == messages.IMU else 'odometry'}", type_name, data)]


def _timed(rig: Rig, sweep: LidarFrame) -> LidarFrame:
    """The sweep with the time of each point: a bag has no other place for the timing of the rig."""
    if sweep.time_offset_s is not None or rig.sweep is None:
        return sweep
    return replace(sweep, time_offset_s=azimuth_offsets_s(sweep.xyz_m, rig.sweep).astype(np.float32))
