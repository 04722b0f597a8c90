"""Output to ROS 2: diagnostics, the calibrated frames, intrinsics, pictures of checks. One thread publishes at least
once a second, whatever else stands still. `/tf_static` gets the served extrinsics, under frame names that mark them
as calibrated. Pictures are rendered only while somebody subscribes, one at a time.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import Config, PairConfig, RosConfig
from coec.geometry import se3
from coec.io.ros import message_encoding, messages
from coec.io.ros.message_encoding import PlacedFrame, ServicePhase, UnsupportedCameraError, encode_jpeg
from coec.io.ros.wire_format import STATIC, Qos
from coec.io.system import ServiceThread
from coec.io.zenoh.ros_node import RosPublisher, RosPublishers
from coec.schemas import keys
from coec.schemas.replies import ExtrinsicReply, HealthReply
from coec.schemas.rig_state import RigReply
from coec.service.worker import worker_jobs
from coec.service.worker.supervisor import Worker


@dataclass(frozen=True, slots=True, eq=False)
class PairOutput:
    """One pair. `serial` is that of its camera; `extrinsic` and `rig` are None while the pair is awaited."""

    health: HealthReply
    serial: str | None
    extrinsic: ExtrinsicReply | None
    rig: Rig | None


@dataclass(frozen=True, slots=True, eq=False)
class VehicleOutput:
    """The service, its pairs and their rig at one moment; `rig` is None if there is only one pair."""

    service: ServicePhase
    pairs: tuple[PairOutput, ...]
    rig: RigReply | None = None


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
        own = f"{camera}_{keys.ros_name(pair)}" if shared else camera
        return f"{own}{self._ros.calibrated_suffix}"


def _frame(frame_id: str) -> str:
    """The name as tf2 has it, without the leading slash of ROS 1."""
    return frame_id.lstrip("/")


PICTURE_PERIOD_S = 1.0
"""Time between two pictures of a pair, s. A picture takes the worker some tenths of a second."""


class CheckPictures:
    """The pictures of all pairs. For any thread."""

    def __init__(self, worker: Worker, topics: Mapping[str, RosPublisher]) -> None:
        """`topics` holds the publishers by names of pairs; further ones may be added later."""
        self._worker = worker
        self._topics = topics
        self._lock = threading.Lock()
        self._requested_s: dict[str, float] = {}
        self._under_way: set[str] = set()

    def show(self, pair: PairConfig, frame_pair: FramePair, T_camera_lidar: Matrix4) -> None:
        """Has a pair of the stream drawn that is being checked at an extrinsic (4, 4), if somebody subscribes and the
        last picture is done and old enough."""
        topic = self._topics.get(pair.name)
        if topic is None or not topic.has_subscribers or not self._begin(pair.name):
            return
        done = partial(self._on_rendered, pair.name, frame_pair.camera.stamp_ns, frame_pair.camera.frame_id)
        self._worker.submit(
            worker_jobs.picture(pair.name, pair.calibration, T_camera_lidar, frame_pair, f"{pair.name}  current", done)
        )

    def _begin(self, pair: str) -> bool:
        now_s = time.monotonic()
        with self._lock:
            if pair in self._under_way or now_s - self._requested_s.get(pair, -PICTURE_PERIOD_S) < PICTURE_PERIOD_S:
                return False
            self._under_way.add(pair)
            self._requested_s[pair] = now_s
        return True

    def _on_rendered(self, pair: str, stamp_ns: int, frame_id: str, outcome: worker_jobs.JobOutcome) -> None:
        with self._lock:
            self._under_way.discard(pair)
        if isinstance(outcome.answer, worker_jobs.RenderedImage):
            self._topics[pair].put(encode_jpeg(stamp_ns, frame_id, outcome.answer.jpeg), time.time_ns())


_log = logging.getLogger(__name__)

DIAGNOSTICS_PERIOD_S: Final = 0.5
"""Longest time between two diagnostics, s. Half of what is promised, so that a busy processor does not break the
promise."""

LEAST_GAP_S: Final = 0.1
"""Shortest time between two diagnostics, s, however often something changes."""

CAMERA_INFO_PERIOD_S: Final = 1.0
"""Time between two intrinsics, s, for subscribers that do not ask for latched ones."""

DIAGNOSTICS_QOS: Final = Qos(depth=1)
"""QoS of `diagnostic_updater`. Depth 1, because one message holds all pairs."""

PICTURES_QOS: Final = Qos(depth=1)
"""Reliable, so that both kinds of subscribers get the pictures. Depth 1, because only the newest is useful."""


@dataclass(frozen=True, slots=True, eq=False)
class _RosCamera:
    """A camera in a form that ROS has words for, as a rig; None if ROS has none. `text` explains it to people."""

    source: Rig
    rig: Rig | None
    text: str


class RosOutputs:
    """Publishes everything that `ros.publish` names, which may be nothing. Its thread is the only one that publishes,
    except for pictures."""

    def __init__(self, publishers: RosPublishers | None, config: Config, worker: Worker) -> None:
        """`publishers` are those of the session; None if it does not speak to ROS. Declares nothing yet."""
        self._publishers = publishers
        self._ros = config.ros
        self._frames = CalibratedFrames(config.ros)
        self._view: Callable[[], VehicleOutput]
        self._diagnostics: RosPublisher | None = None
        self._tf_static: RosPublisher | None = None
        self._camera_info: dict[str, RosPublisher] = {}
        self._overlays: dict[str, RosPublisher] = {}
        self._pictures = CheckPictures(worker, self._overlays)
        self._cameras: dict[str, _RosCamera] = {}
        self._placed: bytes | None = None
        self._info_s = -CAMERA_INFO_PERIOD_S
        self._woken, self._ending = threading.Event(), threading.Event()
        self.threads: tuple[ServiceThread, ...] = ()
        """The thread that publishes; empty if there is nothing to publish, or the session does not speak to ROS."""
        if publishers is not None and config.ros.publish:
            self.threads = (ServiceThread("ros", partial(self._run, publishers)),)

    def start(self, view: Callable[[], VehicleOutput]) -> None:
        """Starts to publish what `view()` returns, on the thread of these outputs."""
        self._view = view
        for thread in self.threads:
            thread.start()

    def wake(self) -> None:
        """Something has changed: publishes soon. For any thread."""
        self._woken.set()

    def show(self, pair: PairConfig, frame_pair: FramePair, T_camera_lidar: Matrix4) -> None:
        """Publishes a picture of a pair of the stream that is being checked at an extrinsic (4, 4), if somebody
        subscribes. For any thread."""
        self._pictures.show(pair, frame_pair, T_camera_lidar)

    def close(self, within_s: float) -> bool:
        """Publishes a last time, and withdraws everything; False if the thread does not end in time."""
        for thread in self.threads:
            thread.request_stop()
        self._ending.set()
        self.wake()
        finished = all(thread.join(within_s) for thread in self.threads)
        if self._publishers is not None:
            self._publishers.close()
        return finished

    # --- on its thread ----------------------------------------------------------------------------------------------

    def _run(self, publishers: RosPublishers, thread: ServiceThread) -> None:
        self._declare(publishers)
        while not thread.stopping:
            thread.beat()
            self._woken.clear()
            published_s = time.monotonic()
            self._publish(publishers)
            self._woken.wait(max(published_s + DIAGNOSTICS_PERIOD_S - time.monotonic(), 0.0))
            self._ending.wait(max(published_s + LEAST_GAP_S - time.monotonic(), 0.0))
        self._publish(publishers)

    def _declare(self, publishers: RosPublishers) -> None:
        """Declares the topics of the whole service."""
        if "diagnostics" in self._ros.publish:
            self._diagnostics = publishers.publisher(keys.DIAGNOSTICS, messages.DIAGNOSTICS, DIAGNOSTICS_QOS)
        if "tf_static" in self._ros.publish:
            self._tf_static = publishers.publisher(keys.TF_STATIC, messages.TF, STATIC)

    def _declare_of(self, publishers: RosPublishers, pair: str) -> None:
        """Declares the topics of a pair, if it is new."""
        if "camera_info" in self._ros.publish and pair not in self._camera_info:
            topic = keys.camera_info_topic(pair)
            self._camera_info[pair] = publishers.publisher(topic, messages.CAMERA_INFO, STATIC)
        if "overlay" in self._ros.publish and pair not in self._overlays:
            topic = keys.overlay_topic(pair)
            self._overlays[pair] = publishers.publisher(topic, messages.COMPRESSED_IMAGE, PICTURES_QOS)

    def _publish(self, publishers: RosPublishers) -> None:
        view, now_ns = self._view(), time.time_ns()
        texts: dict[str, dict[str, str]] = {pair.health.pair: {} for pair in view.pairs}
        for name in texts:
            self._declare_of(publishers, name)
        if self._tf_static is not None:
            self._publish_frames(self._tf_static, view, now_ns, texts)
        if self._camera_info:
            self._publish_cameras(view, now_ns, texts)
        if self._diagnostics is not None:
            statuses = [
                message_encoding.status_of_health(pair.health, view.service, pair.serial, texts[pair.health.pair])
                for pair in view.pairs
            ]
            sensors = () if view.rig is None else view.rig.sensors
            statuses += [
                message_encoding.status_of_sensor(sensor, view.rig.vehicle, view.service)
                for sensor in sensors
                if view.rig is not None
            ]
            self._diagnostics.put(message_encoding.encode_diagnostics(now_ns, statuses), now_ns)

    def _publish_frames(
        self, topic: RosPublisher, view: VehicleOutput, now_ns: int, texts: Mapping[str, dict[str, str]]
    ) -> None:
        """Publishes all frames if any has changed. A latched topic holds only its last message, so every message has
        all frames."""
        transforms = self._frames.transforms([pair.extrinsic for pair in view.pairs if pair.extrinsic is not None])
        for pair, text in transforms.texts.items():
            texts[pair]["tf"] = text
        essence = _essence(transforms.placed)
        if transforms.placed and essence != self._placed:
            self._placed = essence
            topic.put(message_encoding.encode_transforms(transforms.placed, now_ns), now_ns)

    def _publish_cameras(self, view: VehicleOutput, now_ns: int, texts: Mapping[str, dict[str, str]]) -> None:
        now_s = time.monotonic()
        due = now_s - self._info_s >= CAMERA_INFO_PERIOD_S
        self._info_s = now_s if due else self._info_s
        for pair in view.pairs:
            if pair.rig is None:
                continue
            camera = self._camera_of(pair, pair.rig)
            texts[pair.health.pair]["camera_info"] = camera.text
            if due and camera.rig is not None:
                self._camera_info[pair.health.pair].put(message_encoding.encode_camera_info(camera.rig, now_ns), now_ns)

    def _camera_of(self, pair: PairOutput, rig: Rig) -> _RosCamera:
        known = self._cameras.get(pair.health.pair)
        if known is None or known.source is not rig:
            known = self._cameras[pair.health.pair] = _ros_camera(rig)
        return known


def _ros_camera(rig: Rig) -> _RosCamera:
    try:
        camera, residual_px = message_encoding.ros_camera(rig.camera)
    except UnsupportedCameraError as error:
        _log.warning(f"no intrinsics are published to ROS: {error}", extra={"fields": {"pair": rig.pair}})
        return _RosCamera(rig, None, f"not published: {error}")
    text = "as configured" if camera is rig.camera else f"as equidistant, at most {residual_px:.2g} px off"
    return _RosCamera(rig, replace(rig, camera=camera), text)


def _essence(placed: Sequence[PlacedFrame]) -> bytes:
    """The message with a fixed stamp, for comparison with other messages."""
    return message_encoding.encode_transforms(placed, 0)
