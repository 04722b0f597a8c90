"""What is shown of a pair: the image, points on it at each extrinsic, and a thinned cloud. Arrays in, values out;
nothing here depends on the protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.adapters.foxglove import topics
from coec.adapters.foxglove.topics import DisplayedPose
from coec.adapters.frames.incoming import Refusal
from coec.adapters.images.codec import decode_bgr, encode_jpeg
from coec.adapters.images.range_colours import NEAREST_M, WHOLE_SCALE
from coec.adapters.images.raw import BYTES_PER_PIXEL
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import EncodedImage, FramePair, ImageFormat, LidarFrame, Matrix4, Rig
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.in_view import points_in_view
from coec.geometry.thinning import thinned

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
    """The picture of a pair, with the parts for the topics in `wanted`.

    Raises:
        DecodeError: viewers cannot hold the stamp, or the raw pixels do not have the size that they claim.
    """
    if not 0 <= pair.stamp_ns < STAMP_END_NS:
        raise DecodeError(Refusal.STAMP_INVALID, "viewers know stamps from 1970 to 2106")
    overlaid = {pose: one for pose, one in extrinsics.items() if topics.POINTS_TOPICS[pose] in requested}
    xyz_m = compensate(pair, rig, enabled=compensated) if overlaid or topics.CLOUD_TOPIC in requested else NO_POINTS
    silhouette = silhouettes_of(pair.lidar) if overlaid else NO_FLAGS
    return PairPicture(
        stamp_ns=pair.stamp_ns,
        rig=rig,
        extrinsics=extrinsics,
        image=compressed(pair.camera.image, limits) if topics.IMAGE_TOPIC in requested else None,
        marks={pose: marks_of(rig, xyz_m, silhouette, one) for pose, one in overlaid.items()},
        cloud=thin_cloud(xyz_m) if topics.CLOUD_TOPIC in requested else None,
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
    silhouette[range_edges(sweep.xyz_m, sweep.ring).index] = True
    return silhouette


def _bands(uv_px: NDArray[np.float64], range_m: NDArray[np.float64], radius_px: float) -> Iterator[RangeBand]:
    """The points in bands of range, from far to near."""
    number = np.minimum((WHOLE_SCALE.share_of(range_m) * RANGE_BANDS).astype(np.int64), RANGE_BANDS - 1)
    for band in range(RANGE_BANDS - 1, -1, -1):
        if (number == band).any():
            red, green, blue = BAND_RGB[band]
            yield RangeBand((red, green, blue), radius_px, uv_px[number == band] + CORNER_PX)


def thin_cloud(xyz_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """At most `CLOUD_POINTS` of the points (N, 3), each with its range: (n, 4), metres."""
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
