"""The forms in which people write the pose between two sensors: a matrix, or a position with a quaternion or angles;
and the direction in which they give the extrinsic of a pair.
"""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, ValidationError

from coec.config.model import ConfigModel, Matrix4x4, describe

QUATERNION_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1: within this it is rounding, beyond it a mistyped number."""

FORMS = (
    "rows of 4x4 numbers, {xyz: [x, y, z], quaternion_xyzw: [x, y, z, w]}, {xyz: [x, y, z], rpy_deg: [roll, pitch, "
    "yaw]} or the same with rpy_rad"
)

FARTHEST_M = 50.0
"""Largest distance of two sensors of a vehicle; a longer translation is in other units."""

ROTATIONS = ("quaternion_xyzw", "quaternion", "rpy_deg", "rpy_rad")


class _WrittenPose(ConfigModel):
    """A position in metres with one of: a quaternion, its w last (`quaternion` is the same as `quaternion_xyzw`), or
    roll, pitch, yaw about the fixed axes x, y, z (URDF: R = Rz(yaw)·Ry(pitch)·Rx(roll))."""

    xyz: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    quaternion: tuple[float, float, float, float] | None = None
    rpy_deg: tuple[float, float, float] | None = None
    rpy_rad: tuple[float, float, float] | None = None


def _rows_of_pose(value: Any) -> Any:
    """The rows of a pose that is written as a position and a rotation; any other value as it is."""
    if not isinstance(value, dict):
        return value
    from coec.config import poses

    try:
        written = _WrittenPose.model_validate(value)
    except ValidationError as error:
        raise ValueError(f"give {FORMS}: {describe(error)}") from None
    given = [name for name in ROTATIONS if getattr(written, name) is not None]
    if len(given) != 1:
        raise ValueError(f"give {FORMS}: {' and '.join(given) if given else 'no rotation'} is given")
    rotation = getattr(written, given[0])
    if given[0].startswith("rpy"):
        return poses.rows_of_angles(written.xyz, rotation, degrees=given[0] == "rpy_deg")
    length = sum(number * number for number in rotation) ** 0.5
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"{given[0]}: its length is {length:.3g}, not 1; its numbers are x, y, z, w")
    return poses.rows_of(written.xyz, rotation)


def _validated_rigid(rows: Matrix4x4) -> Matrix4x4:
    from coec.config import poses

    problem = poses.rigidity_problem(rows)
    if problem:
        raise ValueError(f"not a rigid transform: {problem}")
    return rows


WrittenPose = Annotated[Matrix4x4, BeforeValidator(_rows_of_pose)]
"""The rows of a pose in any form, not yet checked."""

Pose = Annotated[WrittenPose, AfterValidator(_validated_rigid)]
"""A rigid transform in any form."""


def with_direction(document: Any) -> Any:
    """A document that gives the extrinsic of a pair under one of three names, with `T_camera_lidar` in their place:
    `T_lidar_camera` is its inverse, and `T_camera_cloud` maps from the frame of the points, in which `T_cloud_lidar` is
    the pose of the LiDAR. Any other document is returned as it is.

    Raises:
        ValueError: there are several, or one is not a rigid transform of sensors on one vehicle.
    """
    if not isinstance(document, Mapping):
        return document
    names = [name for name in ("T_camera_lidar", "T_lidar_camera", "T_camera_cloud") if document.get(name) is not None]
    if len(names) > 1:
        raise ValueError(f"{' and '.join(names)} are given: give one of them")
    if not names:
        return document
    from coec.config import poses

    name = names[0]
    rows = _checked(name, document[name])
    rest = {key: value for key, value in document.items() if key != name}
    if name == "T_lidar_camera":
        rows = poses.inverse(rows)
    if name == "T_camera_cloud" and document.get("T_cloud_lidar") is not None:
        rows = poses.product(rows, _checked("T_cloud_lidar", document["T_cloud_lidar"]))
    return {**rest, "T_camera_lidar": rows}


class _OnePose(ConfigModel):
    pose: WrittenPose


def _checked(name: str, value: Any) -> Matrix4x4:
    from coec.config import poses

    try:
        rows = _OnePose(pose=value).pose
    except ValidationError as error:
        raise ValueError(describe(error).replace("pose", name, 1)) from None
    problem = poses.rigidity_problem(rows)
    if problem:
        raise ValueError(f"{name} is not a rigid transform: {problem}")
    length_m = sum(row[3] ** 2 for row in rows[:3]) ** 0.5
    if length_m > FARTHEST_M:
        raise ValueError(
            f"{name}: its translation is {length_m:.0f} m long; it is in metres: divide millimetres by 1000"
        )
    return rows
