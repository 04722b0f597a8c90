"""A vehicle of real ROS 2 nodes behind a bridge's keys: eight lines of configuration, a drive in, diagnostics and the
calibrated frame out, and a wrong mount that a subscriber of rclpy sees: from the start, or by a knock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from coec.calibration.types import EgoMotion, Frame, Matrix4
from coec.geometry import se3
from coec.geometry.se3 import Array
from coec.io.ros import messages
from coec.io.ros.topics import FrameTopics, PairTopics
from coec.io.zenoh.player import stream_of
from coec.schemas.keys import TF_STATIC
from e2e.drives import SECONDS, STEP_S, STEPPED, Drive, rendered
from e2e.processes import Router, Service, portions, service
from peers.environments import peer
from peers.nodes import Inbox, Node, Topic, node, relay
from peers.test_messages_by_rclpy import has_tf

pytest.importorskip("embreex", reason="needs embreex")

STORE = get_typestore(Stores.ROS2_HUMBLE)

DIAGNOSTICS = "/diagnostics"
IMAGE, INFO, POINTS, ODOMETRY = "/front/image/compressed", "/front/camera_info", "/front/points", "/odometry"
NAMES = PairTopics(IMAGE, IMAGE, INFO, POINTS, ODOMETRY, None)

SENSORS = {
    IMAGE: Topic(messages.COMPRESSED_IMAGE),
    INFO: Topic(messages.CAMERA_INFO),
    POINTS: Topic(messages.POINT_CLOUD),
    ODOMETRY: Topic(messages.ODOMETRY),
    TF_STATIC: Topic(messages.TF, latched=True),
}
REPORTED = {DIAGNOSTICS: Topic(messages.DIAGNOSTICS), TF_STATIC: Topic(messages.TF, latched=True)}

CONFIGURATION = """vehicle: shuttle-7
zenoh: {{connect: [{endpoint}]}}
middleware: ros2dds
ros: {{publish: [diagnostics, tf_static]}}
pairs:
  - name: front
    camera: /front/image/compressed
    points: /front/points
    ego: /odometry
    policy: {{apply: never}}
    window: {{pairs: {pairs}, min_pairs: 8, slice_s: {slice_s}, min_points_in_view: 100}}
    monitor: {{period_s: 5, pairs: 5, min_pairs: 4, urgent_slice_s: 16}}
state: {{min_free_bytes: 0}}
"""
"""What a vehicle needs, and after it a person who decides and shorter windows."""

OK, WARN, ERROR, STALE = range(4)
BEGIN_S = 4
SHORT_S, SHORT_PAIRS = 14, 12
SHORT = f"seed=1&seconds={SHORT_S + 2}&camera=pinhole480x240&lidar=32&camera_hz=1&lidar_hz=1&ego_hz=10"
OFF = np.array([*np.radians([2.0, -1.5, 1.0]), 0.0, 0.0, 0.0])
"""By how much `/tf_static` is off the truth of the short drive."""

WITHIN_S = 180.0
MAX_ERROR_DEG = 0.35


@pytest.fixture(scope="module", autouse=True)
def transforms() -> None:
    with peer("ros2", "rclpy_worker.py") as rclpy:
        if not has_tf(rclpy):
            pytest.skip("tf2_msgs is not built: tests/peers/setup builds it where cmake and a compiler are")


class Drivers:
    """Publishes a drive as nodes do: without depth, the calibration on `/tf_static` and in `CameraInfo`."""

    def __init__(self, vehicle: Node, drive: Drive, T_camera_lidar: Matrix4) -> None:
        """`T_camera_lidar` is what `/tf_static` tells."""
        self._vehicle = vehicle
        self._topics = FrameTopics(drive.recording.rig, T_camera_lidar, NAMES)

    def publish(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            for message in self._topics.of(frame):
                self._vehicle.publish(message.topic, message.data)

    def send(self, running: Service, frames: Sequence[Frame]) -> None:
        """In portions that the service's inbox holds, of each the motion first: a drive in seconds overtakes what comes
        on another topic by more than any vehicle does."""
        for portion in portions(frames):
            self._publish_counted(running, [frame for frame in portion if isinstance(frame, EgoMotion)])
            self._publish_counted(running, [frame for frame in portion if not isinstance(frame, EgoMotion)])
        running.rest()

    def _publish_counted(self, running: Service, frames: Sequence[Frame]) -> None:
        sent = Counter(stream_of(frame) for frame in frames)
        before = running.counters()
        due = {stream: before[stream]["received"] + count for stream, count in sent.items()}
        self.publish(frames)
        running.until(
            running.counters,
            lambda pair: all(pair[stream]["received"] >= count for stream, count in due.items()),
            f"what was sent: {dict(sent)}",
        )


def levels(inbox: Inbox) -> list[int]:
    reported: list[Any] = [STORE.deserialize_cdr(data, messages.DIAGNOSTICS) for data in inbox.messages(DIAGNOSTICS)]
    assert all(status.name == "coec: front_calibration" for array in reported for status in array.status)
    return [status.level for array in reported for status in array.status]


def calibrated(inbox: Inbox) -> list[Any]:
    reported: list[Any] = [STORE.deserialize_cdr(data, messages.TF) for data in inbox.messages(TF_STATIC)]
    return [
        joint for message in reported for joint in message.transforms if joint.child_frame_id.endswith("_calibrated")
    ]


@dataclass(frozen=True)
class Bench:
    """A service whose vehicle is a node of ROS, with what its subscriber has heard."""

    running: Service
    drive: Drive
    drivers: Drivers
    inbox: Inbox

    def until(self, topic: str, condition: Callable[[], bool], what: str) -> None:
        self.inbox.until(topic, lambda _: condition(), what, WITHIN_S)

    def complete(self) -> None:
        """The first seconds of the drive tell what the configuration leaves out."""
        self.drivers.publish(self.drive.between(0, BEGIN_S))
        self.running.until(self.running.counters, lambda pair: not pair["awaits"], "what the configuration leaves out")

    def apply(self, second: float) -> None:
        """Nodes have the calibrated frame once a person applies it: the inverse of what is served, at this second of
        the drive right."""
        running, inbox = self.running, self.inbox
        assert calibrated(inbox) == []
        assert running.command("apply")["accepted"]
        self.until(TF_STATIC, lambda: bool(calibrated(inbox)), "the calibrated frame")
        (joint,) = calibrated(inbox)
        served = np.array(running.extrinsic()["camera_from_lidar"]["matrix"])
        assert self.drive.error_deg(running.extrinsic(), second) < MAX_ERROR_DEG
        q, t = joint.transform.rotation, joint.transform.translation
        R = se3.rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))
        np.testing.assert_allclose(se3.transform_from(R, np.array([t.x, t.y, t.z])) @ served, np.eye(4), atol=1e-9)


@contextmanager
def bench(
    folder: Path, router: Router, drive: Drive, off: Array, slice_s: int = 32, pairs: int = 16
) -> Iterator[Bench]:
    """With diagnostics from the first second and to the last. `off`: (6,) rad and m, of what nodes are told."""
    config = folder / "coec.yaml"
    config.write_text(CONFIGURATION.format(endpoint=router.endpoint, pairs=pairs, slice_s=slice_s))
    inbox = Inbox()
    with relay(router.session, SENSORS, REPORTED), node("vehicle", SENSORS, REPORTED, inbox.receive) as vehicle:
        vehicle.wait_for_peers(*SENSORS, DIAGNOSTICS)
        drivers = Drivers(vehicle, drive, se3.perturb(drive.recording.truth(drive.start_ns), off))
        with service(config, router) as running:
            inbox.until(DIAGNOSTICS, lambda reported: len(reported) > 1, "diagnostics from the first second", WITHIN_S)
            assert set(levels(inbox)) == {STALE}, "nothing was looked at"
            yield Bench(running, drive, drivers, inbox)
            assert running.terminate() == 0
        inbox.until(DIAGNOSTICS, lambda _: levels(inbox)[-1] == STALE, "STALE at the end", WITHIN_S)


def test_nodes_see_a_wrong_mount_and_the_calibrated_frame(tmp_path: Path, router: Router) -> None:
    with bench(tmp_path, router, rendered(SHORT), OFF, SHORT_S, SHORT_PAIRS) as vehicle:
        running, inbox = vehicle.running, vehicle.inbox
        vehicle.complete()
        vehicle.drivers.send(running, vehicle.drive.between(BEGIN_S, SHORT_S + 2))
        vehicle.until(DIAGNOSTICS, lambda: levels(inbox)[-1] == ERROR, "the wrong mount")
        vehicle.apply(0)


@pytest.mark.slow
def test_nodes_see_a_knock_and_the_calibrated_frame(tmp_path: Path, router: Router) -> None:
    with bench(tmp_path, router, rendered(STEPPED), np.zeros(6)) as vehicle:
        running, inbox = vehicle.running, vehicle.inbox
        vehicle.complete()
        vehicle.drivers.send(running, vehicle.drive.between(BEGIN_S, STEP_S))
        # On a busy machine time without frames passes while answers are awaited, so that it may be degraded by now.
        assert "healthy" in [entry["code"] for entry in running.entries("state")]
        vehicle.until(DIAGNOSTICS, lambda: OK in levels(inbox), "OK")
        assert ERROR not in levels(inbox)
        vehicle.drivers.send(running, vehicle.drive.between(STEP_S, SECONDS + 1))
        vehicle.until(DIAGNOSTICS, lambda: levels(inbox)[-1] == ERROR, "the knock")
        vehicle.apply(SECONDS)
