"""The WebSocket server for viewers; the only module that needs the library of the optional extra `foxglove`."""

import logging
from typing import Literal

import foxglove
import numpy as np
from foxglove import Channel, Context, channels, messages

from coec.calibration.types import NS_PER_S, EncodedImage
from coec.errors import UnavailableError
from coec.geometry.cameras import Camera
from coec.geometry.se3 import inverse, quaternion_xyzw_from_rotation
from coec.io import viewer_scene

BACKLOG = 32
"""Most messages that wait for a slow viewer, some four pictures; the oldest are dropped first."""

FLOAT_BYTES = 4

TITLE_SHARE = 1 / 60
"""Height of the text on the image, as a share of its width."""


_LOG_LEVELS = (
    messages.LogLevel.Info,
    messages.LogLevel.Warning,
    messages.LogLevel.Error,
    messages.LogLevel.Warning,
)
"""Log level by ROS level: OK, WARN, ERROR, STALE."""


class ViewerServer:
    """Sends to viewers. For use by one thread; the library's own threads send to each viewer at its speed."""

    def __init__(self, host: str, port: int, name: str, camera: Camera) -> None:
        """Listen at a host, without brackets, and a port; 0: any free port. `name` is shown to viewers. If they
        have no model for the pair's `camera`, its intrinsics are no topic.

        Raises:
            UnavailableError: it is not possible to listen there.
        """
        # Do not report viewers that leave without closing, or that send malformed messages.
        logging.getLogger("foxglove").addHandler(logging.NullHandler())
        context = self._context = Context()  # keep it, as its channels close when it is deleted
        self._image = channels.CompressedImageChannel(viewer_scene.IMAGE_TOPIC, context=context)
        self._marks = {
            pose: channels.ImageAnnotationsChannel(topic, context=context)
            for pose, topic in viewer_scene.POINTS_TOPICS.items()
        }
        self._cloud = channels.PointCloudChannel(viewer_scene.CLOUD_TOPIC, context=context)
        self._transforms = channels.FrameTransformsChannel(viewer_scene.TRANSFORMS_TOPIC, context=context)
        self._counterpart = viewer_scene.viewer_camera(camera)
        self._calibration = (
            None
            if self._counterpart is None
            else channels.CameraCalibrationChannel(viewer_scene.CALIBRATION_TOPIC, context=context)
        )
        self._health = Channel(viewer_scene.HEALTH_TOPIC, schema=viewer_scene.timeline_schema(), context=context)
        self._log = channels.LogChannel(viewer_scene.LOG_TOPIC, context=context)
        always = (self._image, *self._marks.values(), self._cloud, self._transforms, self._health, self._log)
        self._all = always if self._calibration is None else (*always, self._calibration)
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, context=context, message_backlog_size=BACKLOG
            )
        except RuntimeError as error:
            cause = str(error).rpartition(": ")[2]
            raise UnavailableError(f"viewers cannot be served at {_address(host, port)}: {cause}") from error
        self.url = f"ws://{_address(host, self._server.port)}"

    @property
    def requested_topics(self) -> frozenset[str]:
        """Topics that some viewer subscribes to."""
        return frozenset(str(channel.topic()) for channel in self._all if channel.has_sinks())

    def send_picture(self, picture: viewer_scene.PairPicture) -> None:
        """Send all parts of a picture, with the stamp of its image."""
        stamp = _stamp(picture.stamp_ns)
        if picture.image is not None:
            self._image.log(_image(picture, picture.image, stamp))
        for row, pose in enumerate(viewer_scene.DisplayedPose):
            if pose in picture.marks:
                self._marks[pose].log(_annotations(picture.marks[pose], row, picture.rig.camera.width, stamp))
        if picture.cloud is not None:
            self._cloud.log(_cloud(picture, picture.cloud, stamp))
        self._transforms.log(_transforms(picture, stamp))
        if self._calibration is not None and self._counterpart is not None:
            self._calibration.log(_calibration(picture, self._counterpart, stamp))

    def send_entry(self, moment: viewer_scene.TimelineEntry) -> None:
        """Send a line of the timeline."""
        self._health.log(moment.document())

    def send_log(self, ros_level: Literal[0, 1, 2, 3], text: str, source: str) -> None:
        """Send a line of the log, with the present time."""
        now = messages.Timestamp.now()
        self._log.log(messages.Log(timestamp=now, level=_LOG_LEVELS[ros_level], message=text, name=source))

    def close(self) -> None:
        """Stop the server, which tells the viewers."""
        self._server.stop()


def _address(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _stamp(stamp_ns: int) -> messages.Timestamp:
    return messages.Timestamp(*divmod(stamp_ns, NS_PER_S))


def _image(
    picture: viewer_scene.PairPicture, image: EncodedImage, stamp: messages.Timestamp
) -> messages.CompressedImage:
    frame = viewer_scene.frame_of(picture.rig.camera_frame, viewer_scene.DisplayedPose.SERVED)
    return messages.CompressedImage(timestamp=stamp, frame_id=frame, data=image.data, format=str(image.format))


def _annotations(
    marks: viewer_scene.PointMarks, row: int, width_px: int, stamp: messages.Timestamp
) -> messages.ImageAnnotations:
    """Points and a line of text. The text is sent even if no point is in view, because viewers wait for annotations
    with the stamp of the image."""
    size_px = max(8.0, width_px * TITLE_SHARE)
    title = messages.TextAnnotation(
        timestamp=stamp,
        position=messages.Point2(x=0.5 * size_px, y=1.6 * size_px * (row + 1)),
        text=marks.title,
        font_size=size_px,
        text_color=messages.Color(r=1.0, g=1.0, b=1.0, a=1.0),
        background_color=messages.Color(r=0.0, g=0.0, b=0.0, a=0.6),
    )
    points = [
        messages.PointsAnnotation(
            timestamp=stamp,
            type=messages.PointsAnnotationType.Points,
            points=[messages.Point2(x=u, y=v) for u, v in band.uv_corner_px.tolist()],
            outline_color=messages.Color(r=band.rgb[0], g=band.rgb[1], b=band.rgb[2], a=1.0),
            thickness=band.radius_px,
        )
        for band in marks.bands
    ]
    return messages.ImageAnnotations(timestamp=stamp, points=points, texts=[title])


def _cloud(picture: viewer_scene.PairPicture, cloud: np.ndarray, stamp: messages.Timestamp) -> messages.PointCloud:
    names = ("x", "y", "z", "range")
    kind = messages.PackedElementFieldNumericType.Float32
    fields = [
        messages.PackedElementField(name=name, offset=FLOAT_BYTES * at, type=kind) for at, name in enumerate(names)
    ]
    return messages.PointCloud(
        timestamp=stamp,
        frame_id=picture.rig.lidar_frame,
        pose=messages.Pose(
            position=messages.Vector3(x=0.0, y=0.0, z=0.0),
            orientation=messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        ),
        point_stride=FLOAT_BYTES * len(names),
        fields=fields,
        data=cloud.astype("<f4").tobytes(),
    )


def _transforms(picture: viewer_scene.PairPicture, stamp: messages.Timestamp) -> messages.FrameTransforms:
    return messages.FrameTransforms(
        transforms=[
            _pose_in_lidar(picture, pose, extrinsic.T_camera_lidar, stamp)
            for pose, extrinsic in picture.extrinsics.items()
            if extrinsic.T_camera_lidar is not None
        ]
    )


def _pose_in_lidar(
    picture: viewer_scene.PairPicture,
    pose: viewer_scene.DisplayedPose,
    T_camera_lidar: np.ndarray,
    stamp: messages.Timestamp,
) -> messages.FrameTransform:
    """The transform of a camera frame: the pose of the child in the parent, which is the inverse of T_camera_lidar."""
    T_lidar_camera = inverse(T_camera_lidar)
    x, y, z = T_lidar_camera[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_xyzw_from_rotation(T_lidar_camera[:3, :3]).tolist()
    return messages.FrameTransform(
        timestamp=stamp,
        parent_frame_id=picture.rig.lidar_frame,
        child_frame_id=viewer_scene.frame_of(picture.rig.camera_frame, pose),
        translation=messages.Vector3(x=x, y=y, z=z),
        rotation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


def _calibration(
    picture: viewer_scene.PairPicture, counterpart: viewer_scene.ViewerCamera, stamp: messages.Timestamp
) -> messages.CameraCalibration:
    camera = counterpart.camera
    return messages.CameraCalibration(
        timestamp=stamp,
        frame_id=viewer_scene.frame_of(picture.rig.camera_frame, viewer_scene.DisplayedPose.SERVED),
        width=camera.width,
        height=camera.height,
        distortion_model=counterpart.distortion_model,
        D=list(counterpart.coefficients),
        K=[camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
