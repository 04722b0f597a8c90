"""What ROS 2 nodes are told."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.base import Stage

RosOutput = Literal["diagnostics", "tf_static", "camera_info", "overlay"]


class RosConfig(Stage):
    """ROS 2 on the bus, where `middleware` is one of its."""

    domain: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID (rmw_zenoh)")
    namespace: str = Field(
        default="",
        pattern=r"^(/?[A-Za-z_][A-Za-z0-9_]*)*$",
        max_length=128,
        description="of the bridge, where it has one (ros2dds)",
    )
    publish: tuple[RosOutput, ...] = Field(
        default=(), description="what ROS nodes are told: diagnostics, tf_static, camera_info, overlay"
    )
    calibrated_suffix: str = Field(
        default="_calibrated",
        pattern=r"^[A-Za-z0-9_]+$",
        max_length=64,
        description="of the camera's frame whose transform is published: the vehicle's tree owns the camera's own",
    )
    replace_camera_frames: bool = Field(
        default=False,
        description="publish the camera's own frame instead; nobody else may, as a frame has one parent",
    )

    @model_validator(mode="after")
    def _each_once(self) -> RosConfig:
        if len(set(self.publish)) != len(self.publish):
            raise ValueError("publish names something twice")
        return self
