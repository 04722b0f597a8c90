"""Wire models of frames sent to the service in the native encoding: one msgpack map per message.

Stamps are sensor time in integer nanoseconds. Numbers in `bin` columns are little-endian.
"""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from coec.schemas.message import Message, Part

END_OF_ROS_TIME_NS = 2**31 * 10**9
"""The header of a ROS message holds seconds as int32: a later stamp could not be recorded."""

StampNs = Annotated[int, Field(ge=0, lt=END_OF_ROS_TIME_NS, description="sensor time, ns")]
FrameId = Annotated[str, Field(max_length=128, description="coordinate frame of the sensor")]
Sequence = Annotated[int | None, Field(ge=0, lt=2**63, description="frame counter of the sender; gaps count as loss")]
# 1000 m/s and 1000 rad/s lie beyond every vehicle and gyroscope: more is a broken sender, not motion.
Velocity = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Vector3 = tuple[Velocity, Velocity, Velocity]

STRICT = ConfigDict(strict=True)
"""Frames come from anywhere: the text "12" is not the number 12."""


class Image(Part):
    """An image: compressed, or rows of raw pixels without padding."""

    model_config = STRICT

    format: Literal[
        "jpeg",
        "png",
        "mono8",
        "mono16",
        "rgb8",
        "bgr8",
        "rgba8",
        "bgra8",
        "bayer_rggb8",
        "bayer_bggr8",
        "bayer_gbrg8",
        "bayer_grbg8",
        "bayer_rggb16",
        "bayer_bggr16",
        "bayer_gbrg16",
        "bayer_grbg16",
        "yuv422",
        "yuv422_yuy2",
    ] = Field(description="layout of `data`; raw layouts have the names of sensor_msgs; 16-bit values little-endian")
    data: bytes = Field(
        min_length=1, description="the compressed file, or raw pixels: height × width × bytes per pixel"
    )
    width: int | None = Field(default=None, ge=1, description="px; required for raw pixels, else read from `data`")
    height: int | None = Field(default=None, ge=1, description="px; required for raw pixels, else read from `data`")


class Depth(Part):
    """A depth map of the same view as the image, computed by the sender."""

    model_config = STRICT

    format: Literal["png"] = Field(description="8- or 16-bit grey PNG")
    data: bytes = Field(min_length=1, description="any monotonic code of depth or inverse depth; 0 = no value")


class CameraFrame(Message):
    """One exposure."""

    model_config = STRICT

    stamp_ns: StampNs
    frame_id: FrameId
    sequence: Sequence = None
    image: Image
    depth: Depth | None = Field(default=None, description="used in place of a depth network if configured (`stereo`)")


class LidarFrame(Message):
    """One sweep, not motion-compensated. All columns have the same number of rows N."""

    model_config = STRICT

    stamp_ns: StampNs
    frame_id: FrameId
    sequence: Sequence = None
    points: bytes = Field(description="N rows of x y z, float32, m, in the LiDAR frame (x forward, y left, z up)")
    intensity: bytes | None = Field(default=None, description="N float32")
    ring: bytes | None = Field(default=None, description="N uint16, number of the laser")
    time_offset_s: bytes | None = Field(
        default=None, description="N float32, s: when each point was measured, relative to stamp_ns"
    )


class EgoMotion(Message):
    """Velocity of the vehicle, expressed in the ego frame `frame_id` (x forward, y left, z up)."""

    model_config = STRICT

    stamp_ns: StampNs
    frame_id: FrameId
    sequence: Sequence = None
    linear_mps: Vector3 | None = Field(description="x y z, m/s; null: not known, as from an IMU")
    angular_radps: Vector3 = Field(description="about x y z, rad/s")
