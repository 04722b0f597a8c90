"""Publishes to ROS 2, on one thread that does so at least once a second, whatever else stands still."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from coec.adapters.ros import diagnostics, messages, outgoing
from coec.adapters.ros.outgoing import PlacedFrame, UnsupportedCameraError
from coec.adapters.ros.wire.qos import STATIC, Qos
from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.ros_publisher import RosPublisher, RosPublishers
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import Config, PairConfig
from coec.runtime.ros.pictures import CheckPictures, JobSubmitter
from coec.runtime.ros.told import PairOutput, VehicleOutput
from coec.runtime.ros.transforms import CalibratedFrames
from coec.schemas import ros_names

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
    """A camera in a form that ROS has words for, as a rig; None if ROS has none. `word` explains it to people."""

    source: Rig
    rig: Rig | None
    text: str


class RosOutputs:
    """Publishes everything that `ros.publish` names, which may be nothing. Its thread is the only one that publishes,
    except for pictures."""

    def __init__(self, publishers: RosPublishers | None, config: Config, worker: JobSubmitter) -> None:
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
            self._diagnostics = publishers.publisher(ros_names.DIAGNOSTICS, messages.DIAGNOSTICS, DIAGNOSTICS_QOS)
        if "tf_static" in self._ros.publish:
            self._tf_static = publishers.publisher(ros_names.TF_STATIC, messages.TF, STATIC)

    def _declare_of(self, publishers: RosPublishers, pair: str) -> None:
        """Declares the topics of a pair, if it is new."""
        if "camera_info" in self._ros.publish and pair not in self._camera_info:
            topic = ros_names.camera_info_topic(pair)
            self._camera_info[pair] = publishers.publisher(topic, messages.CAMERA_INFO, STATIC)
        if "overlay" in self._ros.publish and pair not in self._overlays:
            topic = ros_names.overlay_topic(pair)
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
                diagnostics.status_of_health(pair.health, view.service, pair.serial, texts[pair.health.pair])
                for pair in view.pairs
            ]
            sensors = () if view.rig is None else view.rig.sensors
            statuses += [
                diagnostics.status_of_sensor(sensor, view.rig.vehicle, view.service)
                for sensor in sensors
                if view.rig is not None
            ]
            self._diagnostics.put(outgoing.encode_diagnostics(now_ns, statuses), now_ns)

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
            topic.put(outgoing.encode_transforms(transforms.placed, now_ns), now_ns)

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
                self._camera_info[pair.health.pair].put(outgoing.encode_camera_info(camera.rig, now_ns), now_ns)

    def _camera_of(self, pair: PairOutput, rig: Rig) -> _RosCamera:
        known = self._cameras.get(pair.health.pair)
        if known is None or known.source is not rig:
            known = self._cameras[pair.health.pair] = _ros_camera(rig)
        return known


def _ros_camera(rig: Rig) -> _RosCamera:
    try:
        camera, residual_px = outgoing.ros_camera(rig.camera)
    except UnsupportedCameraError as error:
        _log.warning(f"no intrinsics are published to ROS: {error}", extra={"fields": {"pair": rig.pair}})
        return _RosCamera(rig, None, f"not published: {error}")
    text = "as configured" if camera is rig.camera else f"as equidistant, at most {residual_px:.2g} px off"
    return _RosCamera(rig, replace(rig, camera=camera), text)


def _essence(placed: Sequence[PlacedFrame]) -> bytes:
    """The message with a fixed stamp, for comparison with other messages."""
    return outgoing.encode_transforms(placed, 0)
