"""A vehicle of real ROS 2 nodes behind a bridge's keys: eight lines of configuration, a drive in, diagnostics and the
calibrated frame out, and a knock that a subscriber of rclpy sees."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from coec.calibration.types import EgoMotion, Frame
from coec.geometry import se3
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
    window: {{pairs: 16, min_pairs: 8, slice_s: 32, min_points_in_view: 100}}
    monitor: {{period_s: 5, pairs: 5, min_pairs: 4, urgent_slice_s: 16}}
state: {{min_free_bytes: 0}}
"""
"""What a vehicle needs, and after it a person who decides and shorter windows."""

OK, WARN, ERROR, STALE = range(4)
BEGIN_S = 4
WITHIN_S = 180.0
MAX_ERROR_DEG = 0.35


@pytest.fixture(scope="module")
def drive() -> Drive:
    return rendered(STEPPED)


@pytest.fixture(scope="module", autouse=True)
def transforms() -> None:
    with peer("ros2", "rclpy_worker.py") as rclpy:
        if not has_tf(rclpy):
            pytest.skip("tf2_msgs is not built: tests/peers/setup builds it where cmake and a compiler are")


class Drivers:
    """Publishes a drive as nodes do: without depth, the calibration on `/tf_static` and in `CameraInfo`."""

    def __init__(self, vehicle: Node, drive: Drive) -> None:
        self._vehicle = vehicle
        self._topics = FrameTopics(drive.recording.rig, drive.recording.truth(drive.start_ns), NAMES)

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


def test_nodes_see_a_knock_and_the_calibrated_frame(tmp_path: Path, drive: Drive, router: Router) -> None:
    config = tmp_path / "coec.yaml"
    config.write_text(CONFIGURATION.format(endpoint=router.endpoint))
    inbox = Inbox()
    with relay(router.session, SENSORS, REPORTED), node("vehicle", SENSORS, REPORTED, inbox.receive) as vehicle:
        vehicle.wait_for_peers(*SENSORS, DIAGNOSTICS)
        drivers = Drivers(vehicle, drive)
        with service(config, router) as running:
            inbox.until(DIAGNOSTICS, lambda reported: len(reported) > 1, "diagnostics from the first second", WITHIN_S)
            assert set(levels(inbox)) == {STALE}, "nothing was looked at"
            drivers.publish(drive.between(0, BEGIN_S))
            running.until(running.counters, lambda pair: not pair["awaits"], "what the configuration leaves out")
            drivers.send(running, drive.between(BEGIN_S, STEP_S))
            # On a busy machine time without frames passes while answers are awaited, so that it may be degraded by now.
            assert "healthy" in [entry["code"] for entry in running.entries("state")]
            inbox.until(DIAGNOSTICS, lambda _: OK in levels(inbox), "OK", WITHIN_S)
            assert ERROR not in levels(inbox)
            drivers.send(running, drive.between(STEP_S, SECONDS + 1))
            inbox.until(DIAGNOSTICS, lambda _: levels(inbox)[-1] == ERROR, "the knock", WITHIN_S)
            assert calibrated(inbox) == []
            assert running.command("apply")["accepted"]
            inbox.until(TF_STATIC, lambda _: bool(calibrated(inbox)), "the calibrated frame", WITHIN_S)
            (joint,) = calibrated(inbox)
            served = np.array(running.extrinsic()["camera_from_lidar"]["matrix"])
            assert drive.error_deg(running.extrinsic(), SECONDS) < MAX_ERROR_DEG
            q, t = joint.transform.rotation, joint.transform.translation
            R = se3.rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))
            np.testing.assert_allclose(se3.transform_from(R, np.array([t.x, t.y, t.z])) @ served, np.eye(4), atol=1e-9)
            assert running.terminate() == 0
        inbox.until(DIAGNOSTICS, lambda _: levels(inbox)[-1] == STALE, "STALE at the end", WITHIN_S)
