"""A vehicle whose sensors are told once each: which pairs follow, by which poses, and what is said of mistakes."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from coec.config import Config, config_of, load_config
from coec.errors import ConfigError
from coec.geometry import se3
from coec.reports.commented_yaml import commented_yaml
from conftest import REPOSITORY

AHEAD = {"xyz": [2.0, 0.1, 1.5], "quaternion": [-0.5, 0.5, -0.5, 0.5]}
BEHIND = {"xyz": [-1.0, 0.0, 1.5], "quaternion": [-0.5, -0.5, 0.5, 0.5]}
LEVEL = {"xyz": [1.0, 0.0, 2.0], "quaternion": [0.0, 0.0, 0.0, 1.0]}
INTRINSICS = {"model": "pinhole", "width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5}
ROOF = {"name": "roof", "key": "roof", "T_vehicle_lidar": LEVEL}
BUMPER = {
    "name": "bumper",
    "key": "bumper",
    "T_vehicle_lidar": {**LEVEL, "xyz": [3.0, 0.0, 0.5]},
    "field_of_view": {"azimuth_deg": [-60.0, 60.0]},
}


def rig(**changes: Any) -> dict[str, Any]:
    """Two cameras and a LiDAR; `None` leaves a key out."""
    document = {
        "cameras": [
            {"name": "front", "key": "front", "T_vehicle_camera": AHEAD, "intrinsics": INTRINSICS},
            {"name": "rear", "key": "rear", "T_vehicle_camera": BEHIND, "intrinsics": INTRINSICS},
        ],
        "lidars": [ROOF],
        "ego": {"key": "odometry"},
        "pairs": "all",
        **changes,
    }
    return copy.deepcopy({name: value for name, value in document.items() if value is not None})


def names(config: Config) -> list[str]:
    return [pair.name for pair in config.every_pair]


def test_eight_cameras_and_three_lidars_are_reported_in_sixty_lines(record_property: Any) -> None:
    path = REPOSITORY / "deploy" / "examples" / "rig.yaml"
    lines = path.read_text().splitlines()
    record_property("figure", f"{len(lines)} lines")
    assert len(lines) <= 60
    config = load_config(path)
    assert {pair.camera.name for pair in config.pairs} == {
        *("front", "front_far", "front_left", "front_right", "left", "right", "rear", "rear_wide")
    }
    assert {pair.lidar.name for pair in config.pairs} == {"roof", "left", "right"}
    assert "front-left" in config.left_out, "the LiDAR on the left looks behind"
    assert "left-left" in names(config)
    assert "left-right" in config.left_out, "a strip at the edge of the lens"


def test_what_both_sensors_of_a_pair_are_reported_comes_to_its_nominal_calibration() -> None:
    (front, _) = config_of(rig()).pairs
    assert front.ego is not None
    # 10 m ahead of the vehicle's frame, 1 m to the left, on the ground.
    p_lidar = se3.inverse(np.array([[1, 0, 0, 1.0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]])) @ [
        10.0,
        1.0,
        0.0,
        1.0,
    ]
    assert np.array(front.T_camera_lidar) @ p_lidar == pytest.approx([-0.9, 1.5, 8.0, 1.0])
    assert np.array(front.ego.T_lidar_ego) @ [10.0, 1.0, 0.0, 1.0] == pytest.approx(p_lidar)
    assert (front.camera.frame_id, front.lidar.frame_id) == ("front", "roof")


def test_rows_and_one_line_give_the_same_pose() -> None:
    rows = [[0.0, 0.0, 1.0, 2.0], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
    written = rig()
    written["cameras"][0]["T_vehicle_camera"] = rows
    assert config_of(written) == config_of(rig())


def test_pairs_bear_the_names_of_their_sensors() -> None:
    assert names(config_of(rig())) == ["front", "rear"]
    assert names(config_of(rig(lidars=[ROOF, BUMPER]))) == ["front-roof", "front-bumper", "rear-roof"]
    listed = [{"camera": "front", "lidar": "bumper"}, {"camera": "rear", "lidar": "roof", "name": "back"}]
    assert names(config_of(rig(lidars=[ROOF, BUMPER], pairs=listed))) == ["front-bumper", "back"]


def test_only_sensors_that_see_something_in_common_are_paired_and_the_others_are_reported() -> None:
    assert config_of(rig(lidars=[ROOF, BUMPER])).left_out == ("rear-bumper",)
    assert config_of(rig()).left_out == ()
    with pytest.raises(ConfigError, match="no camera sees what a LiDAR sees"):
        config_of(rig(cameras=rig()["cameras"][1:], lidars=[BUMPER]))


def test_what_is_listed_is_a_pair_whatever_its_sensors_see() -> None:
    config = config_of(rig(lidars=[ROOF, BUMPER], pairs=[{"camera": "rear", "lidar": "bumper"}]))
    assert names(config) == ["rear-bumper"]
    assert config.left_out == ()


def test_a_pair_says_what_it_has_of_its_own_and_the_rig_what_all_have() -> None:
    stages = {"monitor": {"period_s": 20.0, "pairs": 8}, "policy": {"apply": "never"}}
    own = [{"camera": "front", "lidar": "roof", "monitor": {"period_s": 7.0}}, {"camera": "rear", "lidar": "roof"}]
    front, rear = config_of(rig(stages=stages, pairs=own)).pairs
    assert (front.monitor.period_s, front.monitor.pairs, front.policy.apply) == (7.0, 8, "never")
    assert (rear.monitor.period_s, rear.monitor.pairs, rear.policy.apply) == (20.0, 8, "never")


def test_the_long_form_reads_back_to_the_same() -> None:
    config = config_of(rig(lidars=[ROOF, BUMPER], links=[link()]))
    assert Config.model_validate_json(config.model_dump_json()) == config


def test_what_is_shown_of_a_rig_can_be_read(tmp_path: Any) -> None:
    config = config_of(rig(lidars=[ROOF, BUMPER], links=[link()]))
    path = tmp_path / "coec.yaml"
    path.write_text(commented_yaml(config))
    read = load_config(path)
    assert read.pairs == config.pairs
    assert (read.links, read.left_out) == (config.links, config.left_out)


def test_topics_of_ros_leave_the_poses_to_be_discovered() -> None:
    cameras = [{"name": name, "topic": f"/{name}/image_raw/compressed"} for name in ("front", "rear")]
    config = config_of(
        rig(middleware="rmw_zenoh", cameras=cameras, lidars=[{"name": "roof", "topic": "/points"}], ego=None)
    )
    assert [pair.name for pair in config.awaited] == ["front", "rear"]
    assert {pair.T_camera_lidar for pair in config.awaited} == {None}
    assert {pair.camera.frame_id for pair in config.awaited} == {None}, "the frames of the messages"


def link(**changes: Any) -> dict[str, Any]:
    known = {"camera_a": "front", "camera_b": "rear", "sigma_deg": 0.05, "sigma_m": 0.002}
    document = {**known, "T_a_b": {"xyz": [0.0, 0.0, -3.0], "quaternion": [0.0, 1.0, 0.0, 0.0]}, **changes}
    return {name: value for name, value in document.items() if value is not None}


def test_known_links_stand_next_to_the_pairs() -> None:
    (known,) = config_of(rig(links=[link()])).links
    assert known.ends == ("front", "rear")
    assert np.array(known.T_a_b) @ [0.0, 0.0, 1.0, 1.0] == pytest.approx([0.0, 0.0, -4.0, 1.0])
    assert (known.sigma_deg, known.sigma_m) == (0.05, 0.002)


def camera(**changes: Any) -> dict[str, Any]:
    document = {**rig()["cameras"][0], **changes}
    return {name: value for name, value in document.items() if value is not None}


@pytest.mark.parametrize(
    ("document", "reported"),
    [
        (
            rig(cameras=[camera(intrinsics={**INTRINSICS, "fx": -1})]),
            r"cameras\.front\.intrinsics\.fx: .*greater than 0",
        ),
        (rig(cameras=[camera(colour="red")]), r"cameras\.front\.colour: there is no such key"),
        (rig(cameras=[camera(), camera()]), "cameras: front is given twice"),
        (rig(cameras=[camera(intrinsics=None)]), r"cameras\.front\.intrinsics: must be given where"),
        (rig(lidars=[{"name": "roof", "key": "roof"}]), r"lidars\.roof\.T_vehicle_lidar: must be given where"),
        (rig(cameras=[camera(T_vehicle_camera={"xyz": [0, 0, 0]})]), r"cameras\.front\.T_vehicle_camera: .*quaternion"),
        (
            rig(cameras=[camera(T_vehicle_camera={"xyz": [0, 0, 0], "quaternion": [1, 1, 0, 0]})]),
            r"cameras\.front\.T_vehicle_camera: .*its length is 1\.41",
        ),
        (
            rig(cameras=[camera(T_vehicle_camera=[[1, 0, 0, 0]] * 4)]),
            r"cameras\.front\.T_vehicle_camera: .*not a rigid",
        ),
        (rig(cameras=[camera(intrinsics={**INTRINSICS, "k1": 0.1})]), r"cameras\.front\.intrinsics: .*k1"),
        (rig(pairs="some"), "pairs: .*give `all`, or a list"),
        (rig(pairs=None), "pairs: is missing"),
        (rig(pairs=[{"camera": "top", "lidar": "roof"}]), r"pairs\.0\.camera: there is no camera top; there are front"),
        (rig(cameras=None), "cameras: is missing"),
        ({"pairs": "all"}, "cameras: is missing; lidars: is missing"),
        (rig(cameras=[camera(name="n" * 40)], lidars=[{**ROOF, "name": "l" * 40}, BUMPER]), "more than 64 characters"),
        (rig(links=[link(camera_b="top")]), r"links\.0: no pair has a camera of the name top; there are: front, rear"),
        (rig(links=[link(camera_b=None, lidar_b="roof")]), r"links\.0: .*a link is of two cameras"),
        (rig(links=[link(sigma_deg=0)]), r"links\.0\.sigma_deg"),
        (rig(ego={"key": "e", "T_lidar_ego": [[1, 0, 0, 0]] * 4}), r"ego\.T_lidar_ego"),
        (
            rig(lidars=[{**BUMPER, "field_of_view": {"azimuth_deg": [60, -60]}}]),
            r"lidars\.bumper\.field_of_view: .*from, to",
        ),
        (rig(cameras=[7]), r"cameras\.0: "),
    ],
)
def test_mistakes_are_reported_by_their_places(document: dict[str, Any], reported: str) -> None:
    with pytest.raises(ConfigError, match=reported):
        config_of(document)


def test_one_name_is_one_sensor() -> None:
    pairs = [pair.model_dump(exclude_none=True) for pair in config_of(rig()).pairs]
    pairs[1]["camera"]["name"] = "front"
    with pytest.raises(ConfigError, match="camera front cannot be on front and on rear"):
        config_of({"pairs": pairs})
