"""What ROS nodes are told by a running service: diagnostics at any time, frames once they are calibrated, intrinsics,
pictures for whoever looks."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh

from coec.config import (
    CalibrationConfig,
    DepthConfig,
    ObjectiveConfig,
    PolicyConfig,
    WindowConfig,
    load_config,
)
from coec.reports.commented_yaml import commented_yaml
from e2e.drives import SHORT, SHORT_PAIRS, Drive, rendered
from e2e.processes import PATIENCE_S, Router, service, write_configuration
from e2e.ros_listener import listening, speaking_to_ros
from support.fake_worker import wait_until

OK, WARN, ERROR, STALE = range(4)
NS_PER_S = 1_000_000_000
SHORT_S = 12
STALE_AFTER_S = 6.0
NOMINAL_OFF = np.array([*np.radians([2.0, -1.5, 1.0]), 0.0, 0.0, 0.0])
PAIR = "sim"


@pytest.fixture(scope="module")
def drive() -> Drive:
    pytest.importorskip("embreex", reason="needs embreex")
    return rendered(SHORT)


def configured(folder: Path, drive: Drive, router: Router) -> Path:
    """The mount is off by two degrees from its nominal pose, and nobody but a person may change what is served."""
    path = write_configuration(
        folder,
        drive.recording,
        router.endpoint,
        NOMINAL_OFF,
        window=WindowConfig(pairs=SHORT_PAIRS, min_pairs=4, slice_s=SHORT_S),
        calibration=CalibrationConfig(depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi")),
        policy=PolicyConfig(apply="never"),
    )
    reported = {"stale_after_s": STALE_AFTER_S, "vehicle": "shuttle-7"}
    path.write_text(commented_yaml(load_config(path).model_copy(update=reported)))
    speaking_to_ros(path, "diagnostics", "tf_static", "camera_info", "overlay")
    return path


def stamp_s(header: Any) -> float:
    return float(header.stamp.sec + header.stamp.nanosec / 1e9)


def tokens(session: zenoh.Session) -> list[str]:
    replies = list(session.liveliness().get("@ros2_lv/0/**", timeout=PATIENCE_S))
    return sorted(str(reply.ok.key_expr).split("/", 4)[-1] for reply in replies if reply.ok is not None)


@pytest.mark.fault(
    "the mount is off, the worker is killed, the camera falls silent, the service stops",
    "ROS's diagnostics go on at 1 Hz or more: ERROR, then STALE to the end",
)
def test_ros_is_reported_of_everything_from_the_first_second_to_the_last(
    tmp_path: Path, drive: Drive, router: Router, record_property: Any
) -> None:
    overlay = f"/coec/{PAIR}/overlay/compressed"
    config = configured(tmp_path, drive, router)
    with (
        listening(router.session, "/diagnostics", overlay) as nodes,
        service(config, router) as running,
    ):
        wait_until(lambda: nodes.level == STALE, "nothing looked at", PATIENCE_S)
        running.send(drive.frames)
        running.until(running.counters, lambda pair: pair["selected"] >= SHORT_PAIRS - 1, "the pairs")
        assert running.command("calibrate")["accepted"]
        wait_until(lambda: nodes.level == ERROR, "the mount is off", PATIENCE_S)

        # Nothing is calibrated until a person says so; then whoever comes later is told, too.
        with listening(router.session, latched=("/tf_static",)) as early:
            assert running.command("apply")["accepted"]
            wait_until(lambda: bool(early.samples["/tf_static"]), "the frame", PATIENCE_S)
        wait_until(lambda: nodes.level == STALE, "no check has acquitted it yet", PATIENCE_S)
        running.send([replace(frame, stamp_ns=frame.stamp_ns + 60 * NS_PER_S) for frame in drive.frames])
        wait_until(lambda: OK in nodes.levels(PAIR), "what is served is right", PATIENCE_S)
        info = f"/coec/{PAIR}/camera/camera_info"
        with listening(router.session, latched=("/tf_static", info)) as late:
            wait_until(lambda: all(late.samples[topic] for topic in ("/tf_static", info)), "the latched", PATIENCE_S)
            check_frame(late.messages("/tf_static", "tf2_msgs/msg/TFMessage")[0], running.extrinsic())
            camera = late.messages(info, "sensor_msgs/msg/CameraInfo")[0]
            assert (camera.width, camera.height, camera.distortion_model) == (240, 120, "plumb_bob")

        wait_until(lambda: bool(nodes.samples[overlay]), "a picture of the check", PATIENCE_S)
        os.kill(running.worker()["pid"], signal.SIGKILL)
        wait_until(lambda: nodes.level == STALE, "nobody looks any more", PATIENCE_S)
        assert tokens(router.session)[0].startswith("0/NN/%/%shuttle_7/coec")
        assert len(tokens(router.session)) == 5
        assert running.terminate() == 0
        wait_until(lambda: not tokens(router.session), "the node gone", PATIENCE_S)

    arrays = nodes.messages("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    stamps = np.array([stamp_s(array.header) for array in arrays])
    record_property("figure", f"{(len(stamps) - 1) / (stamps[-1] - stamps[0]):.1f} Hz")
    assert len(stamps) > stamps[-1] - stamps[0], "once a second"
    assert nodes.levels(PAIR)[-1] == STALE
    assert ", service stopping" in nodes.statuses(PAIR)[-1].message
    assert {status.hardware_id for status in nodes.statuses(PAIR)} == {f"shuttle-7/{PAIR}"}
    pictures = nodes.messages(overlay, "sensor_msgs/msg/CompressedImage")
    sent_s = {frame.stamp_ns / 1e9 + later_s for frame in drive.frames for later_s in (0, 60)}
    assert {stamp_s(picture.header) for picture in pictures} <= sent_s
    samples = cv2.imdecode(pictures[-1].data, cv2.IMREAD_COLOR)
    assert samples is not None
    assert samples.shape[1] == 960


def check_frame(message: Any, extrinsic: Any) -> None:
    """The calibrated camera as a child of the LiDAR: the inverse of what is served."""
    (reported,) = message.transforms
    assert (reported.header.frame_id, reported.child_frame_id) == ("lidar", "camera_calibrated")
    pose = np.linalg.inv(np.array(extrinsic["camera_from_lidar"]["matrix"]))
    moved = reported.transform.translation
    assert np.allclose([moved.x, moved.y, moved.z], pose[:3, 3], atol=1e-12)
    q = reported.transform.rotation
    # The third row of a rotation matrix from its quaternion (Shoemake 1985).
    row = [2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)]
    assert np.allclose(row, pose[2, :3], atol=1e-12)
