"""What is known of a pair that leaves out its calibration, what is missing, and what it comes to."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import Reason
from coec.config import OpenPairConfig
from coec.geometry import se3
from coec.io.ros.camera_info import CameraInfoContent
from coec.io.ros.transforms import StaticTransform, StaticTransforms
from coec.service.discovery import (
    LATEST,
    DiscoveredPair,
    ReceivedImage,
    ReceivedMetadata,
    change_since,
    discover,
    info_topic_of,
    needs_transforms,
)

EYE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
K = (50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0)
INFO = CameraInfoContent("cam", (64, 48), "plumb_bob", (), K, EYE, (0.0,) * 12, (1, 1), (0, 0, 0, 0))

T_BASE_CAMERA = se3.exp(np.array([1.2, -1.2, 1.2, 1.5, 0.0, 1.4]))
T_BASE_TOP = se3.exp(np.array([0.0, 0.0, 0.3, 1.0, 0.0, 1.9]))
T_CAMERA_TOP = se3.inverse(T_BASE_CAMERA) @ T_BASE_TOP


def pair(**of: Any) -> OpenPairConfig:
    return OpenPairConfig.model_validate({"name": "front", "camera": "/front/image_raw", "points": "/top/points", **of})


def received(**of: Any) -> ReceivedMetadata:
    given: dict[str, Any] = {"image": ReceivedImage("cam", 64, 48), "cloud": "top", "ego": "base", "info": INFO}
    return ReceivedMetadata(**given | of)


def tree(*joints: tuple[str, str, NDArray[np.float64]]) -> StaticTransforms:
    transforms = StaticTransforms()
    transforms.add(tuple(StaticTransform(*joint) for joint in joints))
    return transforms


VEHICLE = (("base", "cam", T_BASE_CAMERA), ("base", "top", T_BASE_TOP))


def detected(
    requested: OpenPairConfig, reported: ReceivedMetadata | None = None, transforms: StaticTransforms | None = None
) -> DiscoveredPair:
    result = discover(requested, reported or received(), transforms or tree(*VEHICLE))
    assert isinstance(result, DiscoveredPair), result
    return result


def missing(
    requested: OpenPairConfig, reported: ReceivedMetadata | None = None, transforms: StaticTransforms | None = None
) -> list[str]:
    result = discover(requested, reported or received(), tree(*VEHICLE) if transforms is None else transforms)
    assert not isinstance(result, DiscoveredPair)
    return [reason.code for reason in result]


def test_two_topics_come_to_a_rig() -> None:
    complete = detected(pair(ego="/odometry"))
    built = complete.pair
    assert (built.camera.frame_id, built.lidar.frame_id, built.lidar.cloud_frame_id) == ("cam", "top", None)
    assert built.camera.intrinsics.model == "pinhole"
    np.testing.assert_allclose(built.T_camera_lidar, T_CAMERA_TOP, rtol=0, atol=1e-12)
    assert built.ego is not None
    np.testing.assert_allclose(built.ego.T_lidar_ego, se3.inverse(T_BASE_TOP), rtol=0, atol=1e-12)
    assert complete.origins["camera.intrinsics"].startswith("CameraInfo on /front/camera_info")
    assert complete.origins["T_camera_lidar"] == "/tf_static, between 'cam' and 'top'"


def test_what_the_configuration_gives_it_gives() -> None:
    given = np.eye(4).tolist()
    intrinsics = {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0}
    camera = {"topic": "/front/image_raw", "intrinsics": intrinsics, "frame_id": "mine"}
    requested = pair(camera=camera, T_camera_lidar=given)
    built = detected(requested, received(image=None, info=None), StaticTransforms())
    assert built.pair.camera.frame_id == "mine"
    assert built.pair.camera.intrinsics.fx == 4.0
    np.testing.assert_array_equal(built.pair.T_camera_lidar, given)
    assert set(built.origins) == {"lidar.frame_id"}
    assert info_topic_of(requested) is None
    assert not needs_transforms(requested)


def test_the_frame_of_the_camera_info_leads_to_the_lidar_where_that_of_the_images_does_not() -> None:
    image, info = ReceivedImage("no_such_frame", 64, 48), replace(INFO, frame_id="cam")
    result = detected(pair(), received(image=image, info=info))
    assert result.pair.camera.frame_id == "no_such_frame", "images of another frame are refused"
    np.testing.assert_allclose(result.pair.T_camera_lidar, T_CAMERA_TOP, rtol=0, atol=1e-12)
    assert result.origins["T_camera_lidar"] == (
        "/tf_static, between 'cam' and 'top'; the frame is that of the CameraInfo, the images name 'no_such_frame'"
    )
    assert "of the frame 'cam', the images name 'no_such_frame'" in result.origins["camera.intrinsics"]
    assert missing(pair(), received(image=image, info=replace(INFO, frame_id="nor_this"))) == ["tf_static"]


def test_a_namespace_before_the_name_of_a_frame_is_recognised() -> None:
    reported = received(image=ReceivedImage("/robot/cam", 64, 48), cloud="robot/top", ego="robot/base")
    result = detected(pair(ego="/odom"), reported)
    np.testing.assert_allclose(result.pair.T_camera_lidar, T_CAMERA_TOP, rtol=0, atol=1e-12)
    assert result.origins["T_camera_lidar"] == (
        "/tf_static, between 'cam' and 'top'; '/robot/cam' is taken for 'cam'; 'robot/top' is taken for 'top'"
    )
    assert (result.pair.camera.frame_id, result.pair.lidar.frame_id) == ("/robot/cam", "robot/top")
    assert change_since(result, pair(ego="/odom"), reported, tree(*VEHICLE)) is None
    several = tree(VEHICLE[0], ("base", "left/top", np.eye(4)), ("base", "right/top", np.eye(4)))
    assert missing(pair(), received(), several) == ["tf_static"]
    (reason,) = cast("tuple[Reason, ...]", discover(pair(), received(), several))
    assert reason.text.endswith("or set T_camera_lidar.")


def test_the_frame_of_the_camera_info_is_taken_where_the_images_name_the_body() -> None:
    optical = se3.transform_from(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    ahead_of_top = np.tile(np.array([[20.0, 0.0, 0.0]], np.float32), (50, 1))
    mounted = (("base", "body", np.eye(4)), ("body", "cam", optical), ("base", "top", np.eye(4)))
    reported = received(image=ReceivedImage("body", 64, 48), points_m=ahead_of_top)
    result = detected(pair(), reported, tree(*mounted))
    np.testing.assert_allclose(result.pair.T_camera_lidar, se3.inverse(optical), rtol=0, atol=1e-12)
    assert result.origins["T_camera_lidar"].endswith("that of the CameraInfo, the images name 'body'")
    assert change_since(result, pair(), reported, tree(*mounted)) is None
    moved = tree(*mounted[:2], ("base", "top", T_BASE_TOP))
    assert change_since(result, pair(), reported, moved) is not None
    # Points above the vehicle are in view of neither, or of the body alone.
    above = received(image=ReceivedImage("body", 64, 48), points_m=ahead_of_top[:, [1, 2, 0]])
    np.testing.assert_allclose(detected(pair(), above, tree(*mounted)).pair.T_camera_lidar, np.eye(4), atol=1e-12)


def test_a_transform_with_several_values_is_named() -> None:
    transforms = tree(*VEHICLE)
    transforms.add((StaticTransform("base", "top", T_BASE_TOP @ se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.5]))),))
    origin = detected(pair(), transforms=transforms).origins["T_camera_lidar"]
    assert "'base' -> 'top' comes with several values" in origin
    assert "5.73 deg and" in origin


@pytest.mark.parametrize(
    ("stream", "given", "place"),
    [
        ("camera", {"camera": {"topic": "/front/image_raw", "frame_id": "cam"}}, "camera.frame_id"),
        ("lidar", {"lidar": {"topic": "/top/points", "cloud_frame_id": "top"}, "points": None}, "lidar.cloud_frame_id"),
    ],
)
def test_two_sensors_on_one_topic_are_a_cause_until_one_is_selected(stream: str, given: Any, place: str) -> None:
    reported = received()
    for frame in ("cam", "cam", "other") if stream == "camera" else ("top", "top", "other"):
        reported.add_name(stream, frame)
    result = discover(pair(), reported, tree(*VEHICLE))
    assert isinstance(result, tuple)
    assert [reason.code for reason in result] == ["several_sensors"]
    assert f"(2), 'other' (1). Two sensors publish on it: give each a topic of its own, or choose one with {place}" in (
        result[0].text
    )
    document = {"name": "front", "camera": "/front/image_raw", "points": "/top/points", **given}
    selected = OpenPairConfig.model_validate({key: value for key, value in document.items() if value is not None})
    assert detected(selected, reported).pair.camera.frame_id == "cam"
    for _ in range(LATEST):
        reported.add_name(stream, "cam" if stream == "camera" else "top")
    detected(pair(), reported)


def test_a_lidar_whose_clouds_come_in_another_frame() -> None:
    requested = pair()
    requested = requested.model_copy(update={"lidar": requested.lidar.model_copy(update={"frame_id": "top"})})
    built = detected(requested, received(cloud="/base")).pair
    assert (built.lidar.frame_id, built.lidar.cloud_frame_id) == ("top", "/base")
    np.testing.assert_allclose(built.lidar.T_cloud_lidar, T_BASE_TOP, rtol=0, atol=1e-12)
    np.testing.assert_allclose(built.T_camera_lidar, T_CAMERA_TOP, rtol=0, atol=1e-12)


def test_rectified_images_take_their_own_matrix() -> None:
    p = (40.0, 0.0, 30.0, 0.0, 0.0, 41.0, 22.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    reported = received(info=replace(INFO, model="equidistant", d=(0.1, 0.2, 0.3, 0.4), p=p))
    built = detected(pair(camera="/front/image_rect"), reported).pair
    assert (built.camera.intrinsics.model, built.camera.intrinsics.fx) == ("pinhole", 40.0)


@pytest.mark.parametrize(
    ("reported", "joints", "codes"),
    [
        (ReceivedMetadata(), (), ["no_camera_info", "no_image", "no_cloud"]),
        (received(info=None), VEHICLE, ["no_camera_info"]),
        (received(image=None), VEHICLE, ["no_image"]),
        (received(cloud=None), VEHICLE, ["no_cloud"]),
        (received(ego=None), VEHICLE, ["no_motion"]),
        (received(), (), ["tf_static", "tf_static"]),
        (received(), VEHICLE[:1], ["tf_static", "tf_static"]),
        (received(), (*VEHICLE, ("roof", "top", T_BASE_TOP)), ["tf_static_no_tree", "tf_static_no_tree"]),
        (received(image=ReceivedImage("cam", 64, 40)), VEHICLE, ["camera_info_size"]),
        (received(image=ReceivedImage("", 64, 48)), VEHICLE, ["no_frame_id"]),
        (received(cloud=""), VEHICLE, ["no_frame_id"]),
        (received(info=replace(INFO, k=(0.0,) * 9)), VEHICLE, ["camera_info_refused"]),
        (received(refused={"info": "message_malformed"}), VEHICLE, ["camera_info_refused"]),
    ],
)
def test_what_is_missing_is_reported(reported: ReceivedMetadata, joints: Any, codes: list[str]) -> None:
    assert missing(pair(ego="/odometry"), reported, tree(*joints)) == codes


def test_the_frames_that_are_there_are_listed_and_no_others_text() -> None:
    joints = [("base", f"f{index}", np.eye(4)) for index in range(40)]
    transforms = tree(*joints, ("base", "\x1b[2Jevil", np.eye(4)))
    result = discover(pair(), received(cloud="\x1b[31m"), transforms)
    assert not isinstance(result, DiscoveredPair)
    (text,) = (reason.text for reason in result)
    assert "'cam' and (a frame whose name is not plain)" in text
    assert "there are base, f0" in text
    assert "17 more" in text
    assert "\x1b" not in text
    assert "evil" not in text


def test_what_the_bus_reports_otherwise_is_reported() -> None:
    requested, reported = pair(ego="/odometry"), received()
    built = detected(requested, reported)
    assert change_since(built, requested, reported, tree(*VEHICLE)) is None
    assert change_since(built, requested, ReceivedMetadata(), StaticTransforms()) is None, "silence says nothing"
    moved = tree(VEHICLE[0], ("base", "top", se3.perturb(T_BASE_TOP, np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))))
    reason = change_since(built, requested, reported, moved)
    assert reason is not None
    assert reason.code == "nominal_changed"
    assert "/tf_static, for T_camera_lidar" in reason.text
    assert "CameraInfo" not in reason.text
    for other in (replace(INFO, k=(50.1, *K[1:])), replace(INFO, k=(0.0,) * 9)):
        reason = change_since(built, requested, received(info=other), tree(*VEHICLE))
        assert reason is not None
        assert "CameraInfo on /front/camera_info" in reason.text
