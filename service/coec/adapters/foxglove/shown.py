"""What of a pair is shown: the image, points on it at each extrinsic, a thinned cloud. Arrays in, values out; nothing
here knows the protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.adapters.foxglove import topics
from coec.adapters.foxglove.topics import Pose
from coec.adapters.frames.incoming import Refusal
from coec.adapters.images.codec import decode_bgr, encode_jpeg
from coec.adapters.images.range_colours import NEAREST_M, WHOLE
from coec.adapters.images.raw import BYTES_PER_PIXEL
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import EncodedImage, FramePair, ImageFormat, LidarFrame, Matrix4, Rig
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.in_view import points_in_view
from coec.geometry.thinning import thinned

POINTS = 5000
"""On the image, at one extrinsic: more cost a viewer its fluency (design notes of ROS 2, Foxglove)."""

CLOUD_POINTS = 20_000
"""Of the sweep in space: 400 kB a frame."""

SILHOUETTES = 3000
"""Of those, at most so many where the sweep jumps from a near surface to a far one: they lie on edges of the image
where an extrinsic is right, and tell it from a wrong one."""

BANDS = 32
"""Colours of ranges: neighbours differ by an eighth of their range."""

POINT_SHARE, SILHOUETTE_SHARE = 1 / 1000, 1 / 600
"""Radius of a point as a share of the image's width: 1.4 px on 1408; and of one that lies on a silhouette."""

LEAST_WIDTH_PX = 720
"""Points on narrower images are no smaller than on this."""

BAND_RGB = (WHOLE.colours_bgr(WHOLE.range_at((np.arange(BANDS) + 0.5) / BANDS))[:, ::-1] / 255).tolist()
"""Colour in the middle of each, from near to far: red, green, blue; 0 to 1."""

CORNER_PX = 0.5
"""Viewers count pixels from the corner of the first one; here its centre is the origin."""

NO_POINTS, NO_FLAGS = np.zeros((0, 3), np.float32), np.zeros(0, np.bool_)

STAMP_END_NS = 2**32 * 1_000_000_000
"""Stamps of viewers end in 2106."""


@dataclass(frozen=True, slots=True, eq=False)
class Extrinsic:
    """T_camera_lidar (4, 4), or None where there is none; and what is written on the image about it."""

    T_camera_lidar: Matrix4 | None
    title: str


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Points of about one range: their colour (red, green, blue; 0 to 1), how large they are drawn, and (N, 2) pixels
    as viewers count them, from the corner of the first one."""

    rgb: tuple[float, float, float]
    radius_px: float
    uv_corner_px: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Points on the image at one extrinsic, in the order in which they are drawn: from far to near, silhouettes on
    top."""

    title: str
    bands: tuple[Band, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One pair as it is shown. What nobody looks at is None, or not in the mapping.

    Attributes:
        image: JPEG or PNG.
        cloud: (N, 4) float32: x, y, z in the LiDAR frame, and range; metres.
    """

    stamp_ns: int
    rig: Rig
    extrinsics: Mapping[Pose, Extrinsic]
    image: EncodedImage | None
    marks: Mapping[Pose, Marks]
    cloud: NDArray[np.float32] | None


def picture_of(
    pair: FramePair,
    rig: Rig,
    extrinsics: Mapping[Pose, Extrinsic],
    wanted: Collection[str],
    limits: LimitsConfig,
    *,
    compensated: bool,
) -> Picture:
    """What is shown of a pair under the topics that are `wanted`.

    Raises:
        DecodeError: a stamp that viewers have no word for, or raw pixels that are none.
    """
    if not 0 <= pair.stamp_ns < STAMP_END_NS:
        raise DecodeError(Refusal.STAMP_INVALID, "viewers know stamps from 1970 to 2106")
    drawn = {pose: one for pose, one in extrinsics.items() if topics.POINTS[pose] in wanted}
    xyz_m = compensate(pair, rig, enabled=compensated) if drawn or topics.CLOUD in wanted else NO_POINTS
    silhouette = silhouettes_of(pair.lidar) if drawn else NO_FLAGS
    return Picture(
        stamp_ns=pair.stamp_ns,
        rig=rig,
        extrinsics=extrinsics,
        image=compressed(pair.camera.image, limits) if topics.IMAGE in wanted else None,
        marks={pose: marks_of(rig, xyz_m, silhouette, one) for pose, one in drawn.items()},
        cloud=thin_cloud(xyz_m) if topics.CLOUD in wanted else None,
    )


def marks_of(rig: Rig, xyz_m: NDArray[np.float32], silhouette: NDArray[np.bool_], extrinsic: Extrinsic) -> Marks:
    """At most `POINTS` of the points (N, 3), LiDAR frame, where the camera sees them at an extrinsic; its title alone
    where there is none. `silhouette` (N,) tells which lie on the near side of a range jump."""
    if extrinsic.T_camera_lidar is None:
        return Marks(extrinsic.title, ())
    seen = points_in_view(rig.camera, extrinsic.T_camera_lidar, xyz_m, rig.mask, NEAREST_M)
    on_edge = np.flatnonzero(silhouette[seen.which])
    beside = np.flatnonzero(~silhouette[seen.which])
    on_edge = on_edge[thinned(len(on_edge), SILHOUETTES)]
    beside = beside[thinned(len(beside), POINTS - len(on_edge))]
    width_px = max(rig.camera.width, LEAST_WIDTH_PX)
    radii_px = (POINT_SHARE * width_px, SILHOUETTE_SHARE * width_px)
    return Marks(
        extrinsic.title,
        tuple(
            band
            for chosen, radius_px in zip((beside, on_edge), radii_px, strict=True)
            for band in _bands(seen.uv_px[chosen], seen.range_m[chosen], radius_px)
        ),
    )


def silhouettes_of(sweep: LidarFrame) -> NDArray[np.bool_]:
    """(N,) which points of a sweep, as it was measured, lie on the near side of a range jump."""
    silhouette = np.zeros(len(sweep.xyz_m), np.bool_)
    silhouette[range_edges(sweep.xyz_m, sweep.ring).index] = True
    return silhouette


def _bands(uv_px: NDArray[np.float64], range_m: NDArray[np.float64], radius_px: float) -> Iterator[Band]:
    """By range, from far to near."""
    number = np.minimum((WHOLE.share_of(range_m) * BANDS).astype(np.int64), BANDS - 1)
    for band in range(BANDS - 1, -1, -1):
        if (number == band).any():
            red, green, blue = BAND_RGB[band]
            yield Band((red, green, blue), radius_px, uv_px[number == band] + CORNER_PX)


def thin_cloud(xyz_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """At most `CLOUD_POINTS` of the points (N, 3), with their range: (n, 4), metres."""
    chosen = xyz_m[thinned(len(xyz_m), CLOUD_POINTS)].astype(np.float64)
    range_m = np.sqrt((chosen**2).sum(axis=1))
    return np.column_stack([chosen, range_m]).astype(np.float32)


def compressed(image: EncodedImage, limits: LimitsConfig) -> EncodedImage:
    """The image as viewers take it: JPEG and PNG as they came, raw pixels as JPEG.

    Raises:
        DecodeError: raw pixels of another size than they say.
    """
    if image.format not in BYTES_PER_PIXEL:
        return image
    return EncodedImage(ImageFormat.JPEG, image.width, image.height, encode_jpeg(decode_bgr(image, limits)))
