"""Poses written in one line, and links: known rigid poses between two sensors of a kind."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from coec.config.base import ConfigModel, Matrix4x4, Name, describe


class _QuaternionPose(ConfigModel):
    """A pose written in one line."""

    xyz: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


QUATERNION_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1: within this it is rounding, beyond it a mistyped number."""


def _pose_rows(value: Any) -> Any:
    """The rows of a pose that is written as a position and a quaternion; any other value as it is."""
    if not isinstance(value, dict):
        return value
    from coec.config import poses

    try:
        written = _QuaternionPose.model_validate(value)
    except ValidationError as error:
        expected = "rows of 4x4 numbers, or {xyz: [x, y, z], quaternion: [x, y, z, w]}"
        raise ValueError(f"give {expected}: {describe(error)}") from None
    length = sum(number * number for number in written.quaternion) ** 0.5
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"quaternion: its length is {length:.3g}, not 1; its numbers are x, y, z, w")
    return poses.rows_of(written.xyz, written.quaternion)


def _validated_rigid(rows: Matrix4x4) -> Matrix4x4:
    from coec.config import poses

    if not poses.is_rigid(rows):
        raise ValueError("not a rigid transform: rows of a rotation, a translation, then 0 0 0 1")
    return rows


Pose = Annotated[Matrix4x4, BeforeValidator(_pose_rows), AfterValidator(_validated_rigid)]
"""A 4x4 matrix, or `{xyz: [x, y, z], quaternion: [x, y, z, w]}` in one line."""


class LinkConfig(ConfigModel):
    """The known pose between two cameras, or between two LiDARs, for example on a stereo bar or a common mount."""

    camera_a: Name | None = Field(default=None, description="name of a camera")
    camera_b: Name | None = Field(default=None, description="name of another camera")
    lidar_a: Name | None = Field(default=None, description="or: name of a LiDAR")
    lidar_b: Name | None = Field(default=None, description="name of another LiDAR")
    T_a_b: Pose = Field(description="pose of b in the frame of a: maps b coordinates to a coordinates")
    sigma_deg: float = Field(gt=0, le=180, description="standard deviation about each axis, degrees")
    sigma_m: float = Field(gt=0, le=10, description="standard deviation along each axis, m")

    @property
    def ends(self) -> tuple[str, str]:
        """Names of a and b."""
        return self.camera_a or self.lidar_a or "", self.camera_b or self.lidar_b or ""

    @model_validator(mode="after")
    def _two_of_a_kind(self) -> LinkConfig:
        cameras, lidars = (self.camera_a, self.camera_b), (self.lidar_a, self.lidar_b)
        of_cameras = None not in cameras and lidars == (None, None)
        of_lidars = None not in lidars and cameras == (None, None)
        if not (of_cameras or of_lidars) or self.ends[0] == self.ends[1]:
            raise ValueError("a link is of two cameras (camera_a, camera_b) or of two LiDARs (lidar_a, lidar_b)")
        return self
