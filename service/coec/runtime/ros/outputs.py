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
from coec.adapters.ros.outgoing import Placed, UnsayableCameraError
from coec.adapters.ros.wire.qos import STATIC, Qos
from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.ros_publisher import RosPublisher, RosPublishers
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import Config, PairConfig
from coec.runtime.ros.pictures import Asks, Pictures
from coec.runtime.ros.told import PairTold, View
from coec.runtime.ros.transforms import CalibratedFrames
from coec.schemas import ros_names

_log = logging.getLogger(__name__)

PERIOD_S: Final = 0.5
"""Longest time between two diagnostics, s. Half of what is promised, so that a busy processor does not break the
promise."""

LEAST_GAP_S: Final = 0.1
"""Shortest time between two diagnostics, s, however often something changes."""

CAMERA_INFO_PERIOD_S: Final = 1.0
"""Time between two intrinsics, s, for subscribers that do not ask for latched ones."""

DIAGNOSTICS: Final = Qos(depth=1)
"""QoS of `diagnostic_updater`. Depth 1, because one message holds all pairs."""

PICTURES: Final = Qos(depth=1)
"""Reliable, so that both kinds of subscribers get the pictures. Depth 1, because only the newest is useful."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sayable:
    """A camera in a form that ROS has words for, as a rig; None if ROS has none. `word` explains it to people."""

    source: Rig
    rig: Rig | None
    word: str


class RosOutputs:
    """Publishes everything that `ros.publish` names, which may be nothing. Its thread is the only one that publishes,
    except for pictures."""

    def __init__(self, publishers: RosPublishers | None, config: Config, worker: Asks) -> None:
        """`publishers` are those of the session; None if it does not speak to ROS. Declares nothing yet."""
        self._publishers = publishers
        self._ros = config.ros
        self._frames = CalibratedFrames(config.ros)
        self._view: Callable[[], View]
        self._diagnostics: RosPublisher | None = None
        self._tf_static: RosPublisher | None = None
        self._camera_info: dict[str, RosPublisher] = {}
        self._overlays: dict[str, RosPublisher] = {}
        self._pictures = Pictures(worker, self._overlays)
        self._sayable: dict[str, _Sayable] = {}
        self._placed: bytes | None = None
        self._info_s = -CAMERA_INFO_PERIOD_S
        self._woken, self._ending = threading.Event(), threading.Event()
        self.threads: tuple[ServiceThread, ...] = ()
        """The thread that publishes; empty if there is nothing to publish, or the session does not speak to ROS."""
        if publishers is not None and config.ros.publish:
            self.threads = (ServiceThread("ros", partial(self._run, publishers)),)

    def start(self, view: Callable[[], View]) -> None:
        """Starts to publish what `view()` returns, on the thread of these outputs."""
        self._view = view
        for thread in self.threads:
            thread.start()

    def wake(self) -> None:
        """Something has changed: publishes soon. For any thread."""
        self._woken.set()

    def show(self, pair: PairConfig, drawn: FramePair, T_camera_lidar: Matrix4) -> None:
        """Publishes a picture of a pair of the stream that is being checked at an extrinsic (4, 4), if somebody
        subscribes. For any thread."""
        self._pictures.show(pair, drawn, T_camera_lidar)

    def close(self, within_s: float) -> bool:
        """Publishes a last time, and withdraws everything; False if the thread does not end in time."""
        for thread in self.threads:
            thread.request_stop()
        self._ending.set()
        self.wake()
        ended = all(thread.join(within_s) for thread in self.threads)
        if self._publishers is not None:
            self._publishers.close()
        return ended

    # --- on its thread ----------------------------------------------------------------------------------------------

    def _run(self, publishers: RosPublishers, thread: ServiceThread) -> None:
        self._declare(publishers)
        while not thread.stopping:
            thread.beat()
            self._woken.clear()
            told_s = time.monotonic()
            self._tell(publishers)
            self._woken.wait(max(told_s + PERIOD_S - time.monotonic(), 0.0))
            self._ending.wait(max(told_s + LEAST_GAP_S - time.monotonic(), 0.0))
        self._tell(publishers)

    def _declare(self, publishers: RosPublishers) -> None:
        """Declares the topics of the whole service."""
        if "diagnostics" in self._ros.publish:
            self._diagnostics = publishers.publisher(ros_names.DIAGNOSTICS, messages.DIAGNOSTICS, DIAGNOSTICS)
        if "tf_static" in self._ros.publish:
            self._tf_static = publishers.publisher(ros_names.TF_STATIC, messages.TF, STATIC)

    def _declare_of(self, publishers: RosPublishers, pair: str) -> None:
        """Declares the topics of a pair, if it is new."""
        if "camera_info" in self._ros.publish and pair not in self._camera_info:
            topic = ros_names.camera_info_topic(pair)
            self._camera_info[pair] = publishers.publisher(topic, messages.CAMERA_INFO, STATIC)
        if "overlay" in self._ros.publish and pair not in self._overlays:
            topic = ros_names.overlay_topic(pair)
            self._overlays[pair] = publishers.publisher(topic, messages.COMPRESSED_IMAGE, PICTURES)

    def _tell(self, publishers: RosPublishers) -> None:
        view, now_ns = self._view(), time.time_ns()
        words: dict[str, dict[str, str]] = {pair.health.pair: {} for pair in view.pairs}
        for name in words:
            self._declare_of(publishers, name)
        if self._tf_static is not None:
            self._tell_frames(self._tf_static, view, now_ns, words)
        if self._camera_info:
            self._tell_cameras(view, now_ns, words)
        if self._diagnostics is not None:
            statuses = [
                diagnostics.of_health(pair.health, view.service, pair.serial, words[pair.health.pair])
                for pair in view.pairs
            ]
            sensors = () if view.rig is None else view.rig.sensors
            statuses += [
                diagnostics.of_sensor(sensor, view.rig.vehicle, view.service)
                for sensor in sensors
                if view.rig is not None
            ]
            self._diagnostics.put(outgoing.encode_diagnostics(now_ns, statuses), now_ns)

    def _tell_frames(self, topic: RosPublisher, view: View, now_ns: int, words: Mapping[str, dict[str, str]]) -> None:
        """Publishes all frames if any has changed. A latched topic holds only its last message, so every message has
        all frames."""
        told = self._frames.transforms([pair.extrinsic for pair in view.pairs if pair.extrinsic is not None])
        for pair, word in told.words.items():
            words[pair]["tf"] = word
        essence = _essence(told.placed)
        if told.placed and essence != self._placed:
            self._placed = essence
            topic.put(outgoing.encode_transforms(told.placed, now_ns), now_ns)

    def _tell_cameras(self, view: View, now_ns: int, words: Mapping[str, dict[str, str]]) -> None:
        now_s = time.monotonic()
        due = now_s - self._info_s >= CAMERA_INFO_PERIOD_S
        self._info_s = now_s if due else self._info_s
        for pair in view.pairs:
            if pair.rig is None:
                continue
            said = self._said(pair, pair.rig)
            words[pair.health.pair]["camera_info"] = said.word
            if due and said.rig is not None:
                self._camera_info[pair.health.pair].put(outgoing.encode_camera_info(said.rig, now_ns), now_ns)

    def _said(self, pair: PairTold, rig: Rig) -> _Sayable:
        known = self._sayable.get(pair.health.pair)
        if known is None or known.source is not rig:
            known = self._sayable[pair.health.pair] = _sayable(rig)
        return known


def _sayable(rig: Rig) -> _Sayable:
    try:
        camera, residual_px = outgoing.sayable(rig.camera)
    except UnsayableCameraError as error:
        _log.warning(f"no intrinsics are published to ROS: {error}", extra={"fields": {"pair": rig.pair}})
        return _Sayable(rig, None, f"not published: {error}")
    word = "as configured" if camera is rig.camera else f"as equidistant, at most {residual_px:.2g} px off"
    return _Sayable(rig, replace(rig, camera=camera), word)


def _essence(placed: Sequence[Placed]) -> bytes:
    """The message with a fixed stamp, for comparison with other messages."""
    return outgoing.encode_transforms(placed, 0)
