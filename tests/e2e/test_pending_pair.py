"""A vehicle of ROS 2 with eight lines of configuration: what they leave out is found on the bus, kept, and watched.

Its router and its nodes have the default settings of rmw_zenoh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.errors import RemoteError
from coec.geometry import se3
from coec.io.zenoh.query_client import query_one
from e2e.drives import Drive, rendered
from e2e.processes import PATIENCE_S, Router, Service, free_endpoint, service
from e2e.ros_vehicle import (
    BLOCK,
    CAMERA,
    EGO,
    INFO,
    POINTS,
    TF,
    Vehicle,
    camera_info,
    configured,
    latched,
    message_of,
    transforms,
)
from support import ros

pytest.importorskip("embreex", reason="needs embreex")

DRIVE = "seed=1&seconds=16&camera=pinhole480x240&lidar=32&camera_hz=1&lidar_hz=1&ego_hz=10"
PAIRS, SLICE_S = 12, 14

SETTINGS = f"""    window: {{pairs: {PAIRS}, min_pairs: 8, slice_s: {SLICE_S}, min_points_in_view: 100}}
state: {{min_free_bytes: 0}}
"""
"""Shorter windows than a vehicle has."""

OFF = np.array([*np.radians([0.8, -0.6, 0.4]), 0.0, 0.0, 0.0])
"""By how much what `/tf_static` says is off the truth."""

MAX_ERROR_DEG = 0.35

T_BASE_LIDAR = se3.exp(np.array([0.0, 0.05, 0.2, 1.1, 0.0, 1.8]))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return rendered(DRIVE)


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    endpoint = free_endpoint()
    with ros.rmw_router(endpoint) as session:
        yield Router(session, endpoint)


@pytest.fixture
def driver(router: Router) -> Iterator[zenoh.Session]:
    """A session of the vehicle's own."""
    with ros.rmw_node(router.endpoint) as session:
        yield session


def reported(drive: Drive, off: np.ndarray[Any, Any] = OFF) -> bytes:
    """`/tf_static` of the vehicle: the LiDAR on the base, and the camera on the base, which is not where it was."""
    rig = drive.recording.rig
    T_camera_lidar = se3.perturb(rig.T_camera_lidar_nominal, off)
    T_base_camera = T_BASE_LIDAR @ se3.inverse(T_camera_lidar)
    return transforms(("base_link", rig.lidar_frame, T_BASE_LIDAR), ("base_link", rig.camera_frame, T_base_camera))


def refused(running: Service, key: str) -> tuple[str, str]:
    with pytest.raises(RemoteError) as error:
        running.query(key)
    return error.value.reply_code, str(error.value)


@pytest.mark.fault(
    "/tf_static says something else after the pair was built", "`nominal_changed` is reported; what is served stays"
)
def test_eight_lines_are_enough(tmp_path: Path, drive: Drive, router: Router, driver: zenoh.Session) -> None:
    rig = drive.recording.rig
    config = configured(tmp_path, router.endpoint, SETTINGS)
    assert len(config.read_text().splitlines()) - len(SETTINGS.splitlines()) <= 8
    vehicle = Vehicle(driver)
    vehicle.latch(TF, reported(drive))  # before the service is there

    with service(config, router) as running:
        keys = running.keys
        health = running.until(running.health, lambda report: "no_image" in codes(report), "what is missing")
        assert (health["state"], health["level"]) == ("unknown", 3)
        assert f"No CameraInfo on {INFO} yet." in health["needs"]
        code, text = refused(running, keys.extrinsic("front"))
        assert code == "awaiting"
        assert f"No CameraInfo on {INFO} yet." in text
        acknowledged = running.command("calibrate")
        assert (acknowledged["accepted"], acknowledged["code"]) == (False, "awaiting")
        assert f"No CameraInfo on {INFO} yet." in acknowledged["text"]

        vehicle.put(INFO, camera_info(rig.camera, rig.camera_frame))
        for frame in drive.frames[:20]:
            vehicle.send(frame)
        running.until(running.counters, lambda pair: not pair["awaits"], "the pair is complete")
        nominal = running.extrinsic()
        expected = se3.perturb(rig.T_camera_lidar_nominal, OFF)
        np.testing.assert_allclose(nominal["camera_from_lidar"]["matrix"], expected, atol=1e-9)
        assert (nominal["provenance"], nominal["status"]) == ("nominal", "not_accepted")
        assert (nominal["camera_frame"], nominal["lidar_frame"]) == (rig.camera_frame, rig.lidar_frame)
        detected = running.counters()["found"]
        assert set(detected) == {
            "camera.intrinsics", "camera.frame_id", "lidar.frame_id", "T_camera_lidar", "ego.T_lidar_ego",
        }  # fmt: skip
        assert "CameraInfo on" in detected["camera.intrinsics"]
        document = running.query(keys.config)
        assert document["found"]["front"] == detected
        assert document["config"]["pairs"][0]["camera"]["intrinsics"]["fx"] == rig.camera.fx
        T_lidar_ego = document["config"]["pairs"][0]["ego"]["T_lidar_ego"]
        np.testing.assert_allclose(T_lidar_ego, se3.inverse(T_BASE_LIDAR), atol=1e-9)
        complete_hash = running.status()["config_hash"]

        running.send_by(vehicle.send, drive.frames)
        running.until(running.counters, lambda pair: pair["windows"] > 0 or pair["selected"] >= PAIRS - 1, "the pairs")
        acknowledged = running.command("calibrate")
        assert acknowledged["accepted"], acknowledged
        running.until(running.extrinsic, lambda report: report["status"] != "not_accepted", "the result")
        result = running.extrinsic()
        assert result["status"] == "accepted"
        assert drive.error_deg(result, 0) < MAX_ERROR_DEG
        assert running.terminate() == 0

    vehicle.close()
    with service(config, router, warm=False) as running:
        # Nobody publishes, and the nominal calibration is the same.
        again = running.extrinsic()
        assert (again["provenance"], again["camera_from_lidar"]) == ("restored", result["camera_from_lidar"])
        assert running.status()["config_hash"] == complete_hash
        assert "kept since" in running.counters()["found"]["T_camera_lidar"]
        assert "nominal_changed" not in codes(running.health())

        later = Vehicle(driver)
        later.latch(TF, reported(drive, 2.0 * OFF))
        report = running.until(
            running.health, lambda report: "nominal_changed" in codes(report), "a change that is told"
        )
        assert "T_camera_lidar" in reason(report, "nominal_changed")
        assert running.extrinsic()["camera_from_lidar"] == again["camera_from_lidar"], "never a silent change"
        assert running.command("reset")["code"] == "reset"
        np.testing.assert_allclose(running.extrinsic()["camera_from_lidar"]["matrix"], expected, atol=1e-9)
        later.latch(TF, reported(drive))
        running.until(running.health, lambda report: "nominal_changed" not in codes(report), "the change is taken back")
        assert running.terminate() == 0
        later.close()


REAR = """  - name: rear
    camera:
      topic: /rear/image_raw
      frame_id: rear
      intrinsics: {model: pinhole, width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5}
    lidar: {topic: /sensing/lidar/top/points, frame_id: lidar}
    T_camera_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""
"""A pair of which everything is given."""


@pytest.mark.fault("rubbish and a flood on /tf_static and CameraInfo, by way of a bridge", "others run; it is counted")
def test_rubbish_and_a_flood_keep_a_pair_waiting_and_no_other(
    tmp_path: Path, drive: Drive, router: Router, driver: zenoh.Session, record_property: Callable[[str, object], None]
) -> None:
    rig, frames = drive.recording.rig, drive.frames
    config = configured(tmp_path, router.endpoint, REAR + "state: {min_free_bytes: 0}\n")
    config.write_text(config.read_text().replace("rmw_zenoh", "ros2dds"))
    with service(config, router, warm=False) as running:
        keys = running.keys
        rear = running.query(keys.extrinsic("rear"))
        assert (rear["provenance"], rear["camera_frame"]) == ("nominal", "rear")
        flood = 2000
        for number in range(flood):
            turned = se3.exp(np.array([0.0, 0.0, 1e-3 * number, 0.0, 0.0, 0.0]))
            driver.put(TF[1:], transforms(("base_link", rig.lidar_frame, turned)), congestion_control=BLOCK)
            if number % 10 == 0:
                for topic in (TF, INFO, CAMERA, POINTS, EGO):
                    driver.put(topic[1:], bytes(number), congestion_control=BLOCK)
        front = partial(running.query, keys.health("front"))
        health = running.until(front, lambda report: "camera_info_refused" in codes(report), "what is refused")
        assert (health["state"], health["level"]) == ("unknown", 3)
        assert refused(running, keys.extrinsic("front"))[0] == "awaiting"
        assert running.query(keys.extrinsic("rear")) == rear
        assert b'pair="front"' in query_one(running.session, keys.metrics, PATIENCE_S).payload

        for name in ("camera", "lidar", "ego"):
            of_stream = {"camera": CameraFrame, "lidar": LidarFrame, "ego": EgoMotion}[name]
            frame = next(frame for frame in frames if isinstance(frame, of_stream))
            topic, payload = message_of(frame)
            driver.put(topic[1:], payload, congestion_control=BLOCK)
        driver.put(INFO[1:], camera_info(rig.camera, rig.camera_frame), congestion_control=BLOCK)
        latched(driver, TF[1:]).put(reported(drive))
        status = running.until(running.status, lambda report: awaits(report, "front") == [], "the pair is complete")
        losses = next(pair for pair in status["pairs"] if pair["name"] == "front")["losses"]
        record_property("figure", f"{sum(losses.values())} of {flood + flood // 2} messages counted as lost")
        assert losses["tf_static_message_malformed"] > 0
        expected = se3.perturb(rig.T_camera_lidar_nominal, OFF)
        np.testing.assert_allclose(
            running.query(keys.extrinsic("front"))["camera_from_lidar"]["matrix"], expected, atol=1e-9
        )
        assert running.query(keys.extrinsic("rear")) == rear
        assert running.terminate() == 0


def awaits(status: Any, name: str) -> list[str]:
    pair = next(pair for pair in status["pairs"] if pair["name"] == name)
    return [str(reason["code"]) for reason in pair["awaits"]]


def codes(health: Any) -> list[str]:
    return [reason["code"] for reason in health["reasons"]]


def reason(health: Any, code: str) -> str:
    return next(str(reason["text"]) for reason in health["reasons"] if reason["code"] == code)
