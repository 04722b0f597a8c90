"""What the service publishes to ROS 2 nodes."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.base import ConfigModel

RosOutput = Literal["diagnostics", "tf_static", "camera_info", "overlay"]


class RosConfig(ConfigModel):
    """ROS 2 on the bus, used if `middleware` is `rmw_zenoh` or `ros2dds`."""

    domain: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID (rmw_zenoh)")
    namespace: str = Field(
        default="",
        pattern=r"^(/?[A-Za-z_][A-Za-z0-9_]*)*$",
        max_length=128,
        description="namespace of the bridge, if it has one (ros2dds)",
    )
    publish: tuple[RosOutput, ...] = Field(
        default=(), description="what is published to ROS nodes: diagnostics, tf_static, camera_info, overlay"
    )
    calibrated_suffix: str = Field(
        default="_calibrated",
        pattern=r"^[A-Za-z0-9_]+$",
        max_length=64,
        description="added to the camera's frame id to name the published frame, as the vehicle's own tree has the "
        "camera's frame",
    )
    replace_camera_frames: bool = Field(
        default=False,
        description="publish the camera's own frame instead; then nobody else may, because a frame has one parent",
    )

    @model_validator(mode="after")
    def _unique_outputs(self) -> RosConfig:
        if len(set(self.publish)) != len(self.publish):
            raise ValueError("publish names something twice")
        return self
