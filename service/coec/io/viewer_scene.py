"""What viewers show of a pair: topics, the camera in their form, the image with points at each extrinsic, a thinned
cloud, and lines of the timeline as JSON. Arrays in, values out: nothing here depends on the protocol.
`deploy/foxglove-layout.json` and all other layouts depend on the names of the topics.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import EncodedImage, FramePair, ImageFormat, LidarFrame, Matrix4, Rig
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.cameras import Camera, intrinsics_of, name_of
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.scan_lines import scan_lines
from coec.geometry.points import thinned
from coec.geometry.projection import points_in_view
from coec.io.frame_validation import BYTES_PER_PIXEL, Refusal
from coec.io.images import NEAREST_M, WHOLE_SCALE, decode_bgr, encode_jpeg
from coec.io.ros.message_encoding import DISTORTION, UnsupportedCameraError, ros_camera

NOT_SERVED = "not_served"
"""State: no service serves the pair, as its liveliness token is absent."""

SILENT = "silent"
"""State: a service serves the pair but does not answer."""

RECORDED = "recorded"
"""State: there is no service; a recording is played."""


class _TimelineModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseAxes(_TimelineModel):
    """Rotation vector about, and translation along, the axes of the camera; unknown values are left out."""

    rx_deg: float | None = None
    ry_deg: float | None = None
    rz_deg: float | None = None
    tx_m: float | None = None
    ty_m: float | None = None
    tz_m: float | None = None


class StreamAges(_TimelineModel):
    """Seconds since the last frame or answer; left out if nothing has come, or if it is not listened to."""

    camera_s: float | None = None
    lidar_s: float | None = None
    ego_s: float | None = None
    answer_s: float | None = Field(default=None, description="since the last word of the service, asked for or not")


class TimelineFigure(_TimelineModel):
    """A figure of self-diagnosis with its limit."""

    name: str
    value: float | None
    limit: float | None
    passed: bool


class MissedFrames(_TimelineModel):
    """Received frames that were not shown."""

    stream: str
    cause: str
    count: int


class TimelineEntry(_TimelineModel):
    """A line of the timeline."""

    pair: str
    state: str = Field(description="state of the pair's health; or not_served, silent, recorded")
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    why: str = Field(description="sentences of the reasons")
    reasons: tuple[str, ...] = Field(default=(), description="codes of the reasons")
    needs: tuple[str, ...] = Field(default=(), description="what is still missing")
    provenance: str | None = Field(default=None, description="where the served extrinsic comes from")
    status: str | None = Field(default=None, description="status of the latest attempt, or of a recording's result")
    percent_complete: float | None = Field(default=None, description="how full the open window is")
    candidate: bool = Field(default=False, description="whether a candidate is shown")
    ages: StreamAges = StreamAges()
    pair_rate_hz: float | None = None
    sync_error_s: float | None = None
    correction: PoseAxes = Field(default=PoseAxes(), description="served extrinsic, from nominal")
    sigma: PoseAxes = Field(default=PoseAxes(), description="standard deviations of `correction`")
    step: PoseAxes = Field(default=PoseAxes(), description="candidate, from the served extrinsic")
    figures: tuple[TimelineFigure, ...] = ()
    not_shown: tuple[MissedFrames, ...] = ()

    def document(self) -> dict[str, Any]:
        """The line in the form in which it is sent."""
        return self.model_dump(mode="json", exclude_none=True)


def timeline_schema() -> dict[str, Any]:
    """JSON Schema of a `Moment`, without references and choices, which viewers do not follow."""
    whole = TimelineEntry.model_json_schema()
    plain: dict[str, Any] = _plain(whole, whole.get("$defs", {}))
    return plain | {"title": "coec.Moment"}


def _plain(node: Mapping[str, Any], parts: Mapping[str, Any]) -> dict[str, Any]:
    if "$ref" in node:
        return _plain(parts[node["$ref"].rpartition("/")[2]], parts)
    if "anyOf" in node:  # a type, or null
        (kind,) = [choice for choice in node["anyOf"] if choice.get("type") != "null"]
        return _plain({**kind, **{key: node[key] for key in ("description",) if key in node}}, parts)
    plain = {key: node[key] for key in ("type", "description") if key in node}
    if "properties" in node:
        plain["properties"] = {name: _plain(one, parts) for name, one in node["properties"].items()}
    if "items" in node:
        plain["items"] = _plain(node["items"], parts)
    return plain


@dataclass(frozen=True, slots=True)
class ViewerCamera:
    """A camera for viewers: their name of its model, its coefficients in their order, and the camera itself, whose
    size, focal lengths and principal point are sent unchanged."""

    camera: Camera
    distortion_model: str
    coefficients: tuple[float, ...]


def viewer_camera(camera: Camera) -> ViewerCamera | None:
    """The camera for viewers. One of a model that they do not know becomes a Kannala-Brandt camera, as for ROS; None if
    that would put points on other pixels."""
    try:
        known, _ = ros_camera(camera)
    except UnsupportedCameraError:
        return None
    model, names = DISTORTION[name_of(known)]
    values = intrinsics_of(known)
    # As Foxglove's messages call it.
    model = "kannala_brandt" if model == "equidistant" else model
    return ViewerCamera(known, model, tuple(float(values[name]) for name in names) or (0.0,) * 5)


class DisplayedPose(StrEnum):
    """Which extrinsic is drawn; also the suffix of its frame's name."""

    SERVED = "served"
    NOMINAL = "nominal"
    CANDIDATE = "candidate"


IMAGE_TOPIC = "/camera/image"
CALIBRATION_TOPIC = "/camera/calibration"
CLOUD_TOPIC = "/lidar/points"
TRANSFORMS_TOPIC = "/tf"
HEALTH_TOPIC = "/health"
LOG_TOPIC = "/log"

POINTS_TOPICS: Mapping[DisplayedPose, str] = {pose: f"/camera/points_{pose}" for pose in DisplayedPose}
"""Topics of the points on the image, one per extrinsic, so that each can be shown or hidden separately."""

PICTURE_TOPICS = frozenset({IMAGE_TOPIC, CALIBRATION_TOPIC, CLOUD_TOPIC, TRANSFORMS_TOPIC, *POINTS_TOPICS.values()})
"""Topics that need the sensors' frames."""

TOPIC_DESCRIPTIONS: Mapping[str, str] = {
    IMAGE_TOPIC: "the camera's image as it came; raw pixels as JPEG",
    **{topic: f"points of the sweep on the image, at the {pose} extrinsic" for pose, topic in POINTS_TOPICS.items()},
    CLOUD_TOPIC: "the sweep, compensated to the instant of the image",
    TRANSFORMS_TOPIC: "pose of the camera in the LiDAR's frame: a frame for each extrinsic",
    CALIBRATION_TOPIC: "intrinsics, in a model that viewers know; absent if none puts the points on the same pixels",
    HEALTH_TOPIC: "once a second and at every change: state, reasons, figures, ages",
    LOG_TOPIC: "a line for every change of the state",
}
"""All topics and what each holds."""


def topics_for(camera: Camera) -> Mapping[str, str]:
    """The topics of a pair with this camera: all but `CALIBRATION_TOPIC`, if viewers have no model for it. A topic on
    which nothing comes is not advertised, because viewers wait for it."""
    if viewer_camera(camera) is not None:
        return TOPIC_DESCRIPTIONS
    return {topic: held for topic, held in TOPIC_DESCRIPTIONS.items() if topic != CALIBRATION_TOPIC}


def frame_of(camera_frame: str, pose: DisplayedPose) -> str:
    """The camera's frame at this extrinsic."""
    return f"{camera_frame}_{pose}"


MAX_POINTS = 5000
"""Most points on the image at one extrinsic; more make a viewer slow (design notes of ROS 2, Foxglove)."""

MAX_CLOUD_POINTS = 20_000
"""Most points of the sweep in space: 400 kB per frame."""

MAX_SILHOUETTES = 3000
"""Most of the `POINTS` that lie on silhouettes, where the sweep jumps from a near surface to a far one. With a right
extrinsic they lie on edges of the image, which shows the difference to a wrong one."""

RANGE_BANDS = 32
"""Number of colours of ranges; neighbouring colours differ by an eighth of their range."""

POINT_SHARE, SILHOUETTE_SHARE = 1 / 1000, 1 / 600
"""Radius of a point, and of one on a silhouette, as a share of the image's width: 1.4 px on 1408 for a point."""

LEAST_WIDTH_PX = 720
"""On narrower images points are as large as on this width."""

BAND_RGB = (
    WHOLE_SCALE.colours_bgr(WHOLE_SCALE.range_at((np.arange(RANGE_BANDS) + 0.5) / RANGE_BANDS))[:, ::-1] / 255
).tolist()
"""Colour in the middle of each band, from near to far: red, green, blue; 0 to 1."""

CORNER_PX = 0.5
"""Offset to the viewers' pixel coordinates, whose origin is the corner of the first pixel; here it is its centre."""

NO_POINTS, NO_FLAGS = np.zeros((0, 3), np.float32), np.zeros(0, np.bool_)

STAMP_END_NS = 2**32 * 1_000_000_000
"""End of the stamps that viewers can hold, in 2106."""


@dataclass(frozen=True, slots=True, eq=False)
class TitledExtrinsic:
    """T_camera_lidar (4, 4), or None if there is none, and the text about it on the image."""

    T_camera_lidar: Matrix4 | None
    title: str


@dataclass(frozen=True, slots=True, eq=False)
class RangeBand:
    """Points of about one range: their colour (red, green, blue; 0 to 1), the radius at which they are drawn, and their
    pixels (N, 2) in viewers' coordinates, from the corner of the first pixel."""

    rgb: tuple[float, float, float]
    radius_px: float
    uv_corner_px: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PointMarks:
    """Points on the image at one extrinsic, in drawing order: from far to near, silhouettes on top."""

    title: str
    bands: tuple[RangeBand, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PairPicture:
    """One pair as it is shown. Parts that no viewer wants are None, or not in the mapping.

    Attributes:
        image: JPEG or PNG.
        cloud: (N, 4) float32: x, y, z in the LiDAR frame, and range; metres.
    """

    stamp_ns: int
    rig: Rig
    extrinsics: Mapping[DisplayedPose, TitledExtrinsic]
    image: EncodedImage | None
    marks: Mapping[DisplayedPose, PointMarks]
    cloud: NDArray[np.float32] | None


def picture_of(
    pair: FramePair,
    rig: Rig,
    extrinsics: Mapping[DisplayedPose, TitledExtrinsic],
    requested: Collection[str],
    limits: LimitsConfig,
    *,
    compensated: bool,
) -> PairPicture:
    """The picture of a pair, with the parts for the topics in `requested`.

    Raises:
        DecodeError: viewers cannot hold the stamp, or the raw pixels do not have the size that they claim.
    """
    if not 0 <= pair.stamp_ns < STAMP_END_NS:
        raise DecodeError(Refusal.STAMP_INVALID, "a viewer's stamps lie between 1970 and 2106")
    overlaid = {pose: one for pose, one in extrinsics.items() if POINTS_TOPICS[pose] in requested}
    xyz_m = compensate(pair, rig, enabled=compensated) if overlaid or CLOUD_TOPIC in requested else NO_POINTS
    silhouette = silhouettes_of(pair.lidar) if overlaid else NO_FLAGS
    return PairPicture(
        stamp_ns=pair.stamp_ns,
        rig=rig,
        extrinsics=extrinsics,
        image=compressed(pair.camera.image, limits) if IMAGE_TOPIC in requested else None,
        marks={pose: marks_of(rig, xyz_m, silhouette, one) for pose, one in overlaid.items()},
        cloud=thin_cloud(xyz_m) if CLOUD_TOPIC in requested else None,
    )


def marks_of(
    rig: Rig, xyz_m: NDArray[np.float32], silhouette: NDArray[np.bool_], extrinsic: TitledExtrinsic
) -> PointMarks:
    """At most `POINTS` of the points (N, 3), LiDAR frame, at the places where the camera sees them with an extrinsic;
    only the title if there is no extrinsic. `silhouette` (N,) marks the points on the near side of a range jump."""
    if extrinsic.T_camera_lidar is None:
        return PointMarks(extrinsic.title, ())
    seen = points_in_view(rig.camera, extrinsic.T_camera_lidar, xyz_m, rig.mask, NEAREST_M)
    on_edge = np.flatnonzero(silhouette[seen.which])
    off_edge = np.flatnonzero(~silhouette[seen.which])
    on_edge = on_edge[thinned(len(on_edge), MAX_SILHOUETTES)]
    off_edge = off_edge[thinned(len(off_edge), MAX_POINTS - len(on_edge))]
    width_px = max(rig.camera.width, LEAST_WIDTH_PX)
    radii_px = (POINT_SHARE * width_px, SILHOUETTE_SHARE * width_px)
    return PointMarks(
        extrinsic.title,
        tuple(
            band
            for indices, radius_px in zip((off_edge, on_edge), radii_px, strict=True)
            for band in _bands(seen.uv_px[indices], seen.range_m[indices], radius_px)
        ),
    )


def silhouettes_of(sweep: LidarFrame) -> NDArray[np.bool_]:
    """(N,) which points of an uncompensated sweep lie on the near side of a range jump."""
    silhouette = np.zeros(len(sweep.xyz_m), np.bool_)
    silhouette[range_edges(scan_lines(sweep.xyz_m, sweep.ring)).index] = True
    return silhouette


def _bands(uv_px: NDArray[np.float64], range_m: NDArray[np.float64], radius_px: float) -> Iterator[RangeBand]:
    """The points in bands of range, from far to near."""
    number = np.minimum((WHOLE_SCALE.share_of(range_m) * RANGE_BANDS).astype(np.int64), RANGE_BANDS - 1)
    for band in range(RANGE_BANDS - 1, -1, -1):
        if (number == band).any():
            red, green, blue = BAND_RGB[band]
            yield RangeBand((red, green, blue), radius_px, uv_px[number == band] + CORNER_PX)


def thin_cloud(xyz_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """At most `MAX_CLOUD_POINTS` of the points (N, 3), each with its range: (n, 4), metres."""
    points_m = xyz_m[thinned(len(xyz_m), MAX_CLOUD_POINTS)].astype(np.float64)
    range_m = np.sqrt((points_m**2).sum(axis=1))
    return np.column_stack([points_m, range_m]).astype(np.float32)


def compressed(image: EncodedImage, limits: LimitsConfig) -> EncodedImage:
    """The image in a form that viewers accept: JPEG and PNG unchanged, raw pixels as JPEG.

    Raises:
        DecodeError: the raw pixels do not have the size that they claim.
    """
    if image.format not in BYTES_PER_PIXEL:
        return image
    return EncodedImage(ImageFormat.JPEG, image.width, image.height, encode_jpeg(decode_bgr(image, limits)))
