"""Whoever listens for what the configuration leaves out: what comes, in what order, and what is none of it."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import Reason
from coec.config import Config
from coec.geometry import se3
from coec.io.ros import messages
from coec.io.zenoh.bus import CDR, InputSample
from coec.service.discovery import DiscoveredPair
from coec.service.discovery_listener import TRANSFORMS_A_TURN, TRANSFORMS_WAITING, DiscoveryListener
from coec.service.ingest.decoder import CAMERA, LIDAR
from support.recordings import STORE, camera_info_message, transform_message
from support.ros import compressed_image, packed_cloud

T_BASE_TOP = se3.exp(np.array([0.0, 0.0, 0.3, 1.0, 0.0, 1.9]))
CLOUD = packed_cloud([("x", "<f4", [1.0, 2.0]), ("y", "<f4", [0.0, 1.0]), ("z", "<f4", [0.0, 1.0])])

CONFIG = Config.model_validate(
    {
        "middleware": "rmw_zenoh",
        "pairs": [{"name": "front", "camera": "/front/image/compressed", "points": "/top/points"}],
    }
)


def transforms_of(*joints: tuple[str, str, NDArray[np.float64]]) -> bytes:
    message = ros.tf2_msgs__msg__TFMessage([transform_message(*joint) for joint in joints])
    return bytes(STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))


def cdr(payload: bytes, type_name: str) -> InputSample:
    return InputSample(payload, f"{CDR};{type_name}")


IMAGE = cdr(compressed_image(), messages.COMPRESSED_IMAGE)
POINTS = cdr(CLOUD, messages.POINT_CLOUD)
INFO = cdr(messages.serialized(camera_info_message("plumb_bob", []), messages.CAMERA_INFO), messages.CAMERA_INFO)
TREE = cdr(transforms_of(("camera", "lidar", T_BASE_TOP)), messages.TF)


def received_all() -> DiscoveryListener:
    watch = DiscoveryListener(CONFIG, {})
    watch.take_frame("front", CAMERA, IMAGE)
    watch.take_frame("front", LIDAR, POINTS)
    watch.take_info("front", INFO)
    watch.take_transforms(TREE)
    return watch


def codes(watch: DiscoveryListener) -> list[str]:
    return [reason.code for reason in watch.nominal("front").awaits]


def test_in_any_order_a_pair_is_ready_once() -> None:
    watch = DiscoveryListener(CONFIG, {})
    assert codes(watch) == ["no_look_yet"]
    watch.update()
    assert codes(watch) == ["no_camera_info", "no_image", "no_cloud"]
    watch.take_transforms(TREE)
    watch.take_info("front", INFO)
    watch.update()
    assert codes(watch) == ["no_image", "no_cloud"]
    watch.take_frame("front", LIDAR, POINTS)
    watch.take_frame("front", CAMERA, IMAGE)
    watch.update()
    assert codes(watch) == ["being_built"]
    ready = watch.ready()
    assert list(ready) == ["front"]
    watch.take_info("front", INFO)
    watch.update()
    assert watch.ready() == {}
    watch.end("front", ready["front"])
    watch.update()
    assert watch.nominal("front").awaits == ()
    assert set(watch.nominal("front").origins) == {
        "camera.intrinsics", "camera.frame_id", "lidar.frame_id", "T_camera_lidar",
    }  # fmt: skip


def test_what_cannot_be_built_is_pending_until_something_else_is_received() -> None:
    watch = received_all()
    watch.update()
    watch.ready()
    watch.end("front", Reason("cannot_be_built", "No."))
    watch.update()
    assert codes(watch) == ["cannot_be_built"]
    watch.take_info("front", INFO)
    watch.update()
    assert (codes(watch), watch.ready()) == (["cannot_be_built"], {})
    watch.take_transforms(cdr(transforms_of(("camera", "lidar", np.eye(4))), messages.TF))
    watch.update()
    assert codes(watch) == ["being_built"]
    np.testing.assert_array_equal(watch.ready()["front"].pair.T_camera_lidar, np.eye(4))


def test_what_changes_after_it_was_built_is_reported_and_changes_nothing() -> None:
    watch = received_all()
    watch.update()
    result = watch.ready()["front"]
    watch.end("front", result)
    watch.update()
    watch.take_transforms(cdr(transforms_of(("camera", "lidar", np.eye(4))), messages.TF))
    watch.update()
    changed = watch.nominal("front").changed
    assert changed is not None
    assert watch.ready() == {}
    watch.take_transforms(TREE)
    watch.update()
    assert watch.nominal("front").changed is None


def test_a_pair_that_was_discovered_before_the_start_is_only_watched() -> None:
    first = received_all()
    first.update()
    earlier = first.ready()
    watch = DiscoveryListener(CONFIG, earlier)
    assert watch.nominal("front").awaits == ()
    watch.take_frame("front", CAMERA, cdr(b"nonsense", messages.COMPRESSED_IMAGE))
    watch.update()
    assert (watch.ready(), watch.nominal("front").losses) == ({}, {})
    assert isinstance(earlier["front"], DiscoveredPair)


@pytest.mark.fault("rubbish on /tf_static, CameraInfo, images and clouds while a pair is awaited", "counted by cause")
def test_rubbish_is_counted_by_its_cause_and_what_comes_after_it_is_taken() -> None:
    watch = DiscoveryListener(CONFIG, {})
    for rubbish in (b"", b"\x00\x01\x00\x00", bytes(100), b"\xff" * 1000):
        watch.take_transforms(cdr(rubbish, messages.TF))
        watch.take_info("front", cdr(rubbish, messages.CAMERA_INFO))
        watch.take_frame("front", CAMERA, cdr(rubbish, messages.COMPRESSED_IMAGE))
        watch.take_frame("front", LIDAR, cdr(rubbish, messages.POINT_CLOUD))
        watch.update()
    watch.take_info("front", cdr(CLOUD, messages.POINT_CLOUD))
    watch.update()
    assert codes(watch) == ["camera_info_refused", "no_image", "no_cloud"]
    losses = watch.nominal("front").losses
    assert (losses["tf_static_message_malformed"], losses["info_wrong_type"]) == (4, 1)
    assert sum(losses.values()) >= 15
    watch.take_transforms(TREE)
    watch.take_info("front", INFO)
    watch.take_frame("front", CAMERA, IMAGE)
    watch.take_frame("front", LIDAR, POINTS)
    watch.update()
    assert codes(watch) == ["being_built"]


@pytest.mark.fault("messages of 32 MB on /tf_static and CameraInfo", "none is kept; they are counted by cause")
def test_messages_larger_than_any_are_not_retained() -> None:
    watch = received_all()
    watch.update()
    watch.ready()
    tracemalloc.start()
    for _ in range(100):
        watch.take_transforms(cdr(bytes(2**22), messages.TF))
        watch.take_transforms(cdr(bytes(2**20), messages.TF))
        watch.take_info("front", cdr(bytes(2**22), messages.CAMERA_INFO))
    held_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held_bytes < 20 * 2**20
    watch.update()
    losses = watch.nominal("front").losses
    assert (losses["tf_static_message_too_large"], losses["tf_static_overrun"]) == (100, 92)
    assert losses["info_message_too_large"] == 1


@pytest.mark.fault("a decoder fails on a sample of a pair that is awaited", "it costs the sample")
def test_a_decoder_that_fails_costs_its_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("broken")

    watch = received_all()
    with monkeypatch.context() as patched:
        patched.setattr("coec.service.ingest.decoder.SampleReader.frame", broken)
        patched.setattr("coec.service.discovery_listener.decode_static_transforms", broken)
        watch.update()
    assert codes(watch) == ["no_image", "no_cloud"]
    assert watch.nominal("front").losses == {
        "camera_decoder_fault": 1, "lidar_decoder_fault": 1, "tf_static_decoder_fault": 1,
    }  # fmt: skip


@pytest.mark.fault("a flood of static transforms", "512 messages wait at most, 64 are read in a quarter of a second")
def test_a_flood_of_transforms_is_bounded_and_the_newest_count() -> None:
    watch = received_all()
    for step in range(3 * TRANSFORMS_WAITING):
        watch.take_transforms(cdr(transforms_of((f"p{step}", f"c{step}", np.eye(4))), messages.TF))
    watch.take_transforms(TREE)
    for _ in range(TRANSFORMS_WAITING // TRANSFORMS_A_TURN):
        watch.update()
    assert watch.nominal("front").losses == {"tf_static_overrun": 2 * TRANSFORMS_WAITING + 2}
    assert codes(watch) == ["being_built"]


def test_raw_images_that_zenoh_drops_are_named_and_counted_by_their_camera_info() -> None:
    config = CONFIG.model_validate(
        {"middleware": "rmw_zenoh", "pairs": [{"name": "front", "camera": "/front/image_raw", "points": "/top/points"}]}
    )
    large = camera_info_message("plumb_bob", [])
    large.width, large.height = 4096, 3000
    watch = DiscoveryListener(config, {})
    for _ in range(3):
        watch.take_info("front", cdr(messages.serialized(large, messages.CAMERA_INFO), messages.CAMERA_INFO))
        watch.update()
    (missing,) = (reason for reason in watch.nominal("front").awaits if reason.code == "no_image")
    assert "36864000 bytes" in missing.text
    assert "limits.max_message_bytes, 33554432" in missing.text
    assert watch.nominal("front").losses == {"camera_message_too_large": 3}
    compressed = DiscoveryListener(CONFIG, {})
    compressed.take_info("front", cdr(messages.serialized(large, messages.CAMERA_INFO), messages.CAMERA_INFO))
    compressed.update()
    assert compressed.nominal("front").losses == {}


def test_an_invalid_transform_is_counted_and_costs_no_other() -> None:
    broken = transform_message("realsense", "depth", np.eye(4))
    broken.transform.rotation = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 0.0)
    message = ros.tf2_msgs__msg__TFMessage([broken, transform_message("camera", "lidar", T_BASE_TOP)])
    watch = DiscoveryListener(CONFIG, {})
    watch.take_frame("front", CAMERA, IMAGE)
    watch.take_frame("front", LIDAR, POINTS)
    watch.take_info("front", INFO)
    watch.take_transforms(cdr(bytes(STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage")), messages.TF))
    watch.update()
    assert codes(watch) == ["being_built"]
    assert watch.nominal("front").losses == {"tf_static_transform_invalid": 1}
    other = DiscoveryListener(CONFIG, {})
    other.take_frame("front", CAMERA, IMAGE)
    other.take_frame("front", LIDAR, POINTS)
    other.take_info("front", INFO)
    alone = ros.tf2_msgs__msg__TFMessage([broken])
    other.take_transforms(cdr(bytes(STORE.serialize_cdr(alone, "tf2_msgs/msg/TFMessage")), messages.TF))
    other.update()
    (missing,) = other.nominal("front").awaits
    assert "Invalid transforms were left out: 'realsense' -> 'depth'." in missing.text


def test_an_empty_camera_info_takes_nothing_away() -> None:
    watch = received_all()
    empty = camera_info_message("plumb_bob", [])
    empty.k = np.zeros(9)
    watch.update()
    watch.take_info("front", cdr(messages.serialized(empty, messages.CAMERA_INFO), messages.CAMERA_INFO))
    watch.update()
    assert codes(watch) == ["being_built"]
    assert watch.nominal("front").losses == {"info_uncalibrated": 1}


def test_two_cameras_on_one_topic_are_named_while_a_pair_is_pending() -> None:
    watch = DiscoveryListener(CONFIG, {})
    watch.take_info("front", INFO)
    for frame in ("camera", "camera_right"):
        watch.take_frame("front", CAMERA, cdr(compressed_image(frame_id=frame), messages.COMPRESSED_IMAGE))
        watch.update()
    (reason,) = (each for each in watch.nominal("front").awaits if each.code == "several_sensors")
    assert "name 2 frames: 'camera' (1), 'camera_right' (1)" in reason.text
