"""The forms in which the pose of a pair is written: one pose in all of them, and what is refused."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from coec.config import OpenPairConfig, poses
from coec.config.model import ConfigModel, describe
from coec.config.pair import Pose, with_direction
from coec.geometry import se3

XYZ = [0.1, -0.2, 0.3]
RPY_DEG = [10.0, -20.0, 130.0]


class Holder(ConfigModel):
    T_a_b: Pose


def rows(value: Any) -> np.ndarray:
    return np.array(Holder(T_a_b=value).T_a_b)


def as_in_urdf() -> np.ndarray:
    """Elementary rotations written out, about the fixed axes, roll first."""
    r, p, y = np.radians(RPY_DEG)
    about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    return se3.transform_from(about_z @ about_y @ about_x, np.array(XYZ))


def test_all_forms_are_one_pose() -> None:
    T = as_in_urdf()
    quaternion = se3.quaternion_xyzw_from_rotation(T[:3, :3]).tolist()
    for written in (
        T.tolist(),
        {"xyz": XYZ, "quaternion_xyzw": quaternion},
        {"xyz": XYZ, "quaternion": quaternion},
        {"xyz": XYZ, "rpy_deg": RPY_DEG},
        {"xyz": XYZ, "rpy_rad": np.radians(RPY_DEG).tolist()},
    ):
        assert rows(written) == pytest.approx(T, abs=1e-12)


def test_three_directions_of_one_extrinsic() -> None:
    T, T_cloud_lidar = as_in_urdf(), poses.rows_of((0.9, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))
    for document in (
        {"T_camera_lidar": T.tolist()},
        {"T_lidar_camera": se3.inverse(T).tolist()},
        {"T_camera_cloud": (T @ se3.inverse(np.array(T_cloud_lidar))).tolist(), "T_cloud_lidar": T_cloud_lidar},
    ):
        assert np.array(with_direction(document)["T_camera_lidar"]) == pytest.approx(T, abs=1e-12)
    assert with_direction({"other": 1}) == {"other": 1}


MIRRORED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        (MIRRORED, "its determinant is -1, so it mirrors"),
        ([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "orthonormal only to 0.1"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]], r"its last row is 1 2 3 1 \(is it transposed\?\)"),
        ({"xyz": XYZ}, "no rotation is given"),
        ({"xyz": XYZ, "rpy_deg": [0, 0, 0], "rpy_rad": [0, 0, 0]}, "rpy_deg and rpy_rad is given"),
        ({"xyz": XYZ, "rpy": [0, 0, 0]}, "rpy: there is no such key"),
        ({"xyz": XYZ, "quaternion_xyzw": [0, 0, 0, 2]}, "quaternion_xyzw: its length is 2, not 1"),
    ],
)
def test_what_is_no_pose_is_refused_with_the_reason(value: Any, complaint: str) -> None:
    with pytest.raises(ValidationError) as refused:
        rows(value)

    assert re.search(complaint, describe(refused.value))


def test_a_translation_in_millimetres_and_two_directions_are_refused() -> None:
    T = as_in_urdf()
    T[:3, 3] *= 1000.0
    with pytest.raises(ValueError, match=r"T_lidar_camera: its translation is 374 m long.*divide millimetres by 1000"):
        with_direction({"T_lidar_camera": T.tolist()})
    with pytest.raises(ValueError, match="T_camera_lidar and T_lidar_camera are given: give one of them"):
        with_direction({"T_lidar_camera": T.tolist(), "T_camera_lidar": T.tolist()})


def test_a_pair_takes_its_pose_in_either_direction() -> None:
    T = as_in_urdf()
    pair = {"name": "front", "camera": {"topic": "/image"}, "lidar": {"topic": "/points"}}
    given = OpenPairConfig.model_validate({**pair, "T_lidar_camera": {"xyz": XYZ, "rpy_deg": RPY_DEG}})
    assert np.array(given.T_camera_lidar) == pytest.approx(se3.inverse(T), abs=1e-12)
    given = OpenPairConfig.model_validate({**pair, "T_camera_lidar": {"xyz": XYZ, "rpy_deg": RPY_DEG}})
    assert np.array(given.T_camera_lidar) == pytest.approx(T, abs=1e-12)
