"""Classical mistakes in the inputs of a calibration, and what the inputs would be without each.

A pose is given in the wrong direction, with a quaternion in the wrong order, or between other axes; intrinsics belong
to an image of another size; an image is turned or mirrored. Each leaves inputs that look sound and fit nothing.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Rig
from coec.geometry import cameras, se3
from coec.geometry.cameras import Camera

AS_GIVEN = "as_given"


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of mistake.

    Attributes:
        odds: prior probability, relative to the other kinds.
        tried: what was done to the inputs, after "with".
        advice: what is probably wrong, and what to do.
    """

    odds: float
    tried: str
    advice: str


INVERSE_POSE, INVERSE_ROTATION, INVERSE_TRANSLATION = "inverse_pose", "inverse_rotation", "inverse_translation"
QUATERNION_ORDER, CAMERA_AXES, INVERSE_AND_AXES = "quaternion_order", "camera_axes", "inverse_and_axes"
TRANSLATION = "translation_wrong"
LIDAR_AXES, POSE_UNIT, CLOUD_FRAME = "lidar_axes", "pose_unit", "cloud_frame"
FOCAL_LENGTH, IMAGE_SCALE, PRINCIPAL_POINT = "focal_length", "image_scale", "principal_point"
FOCAL_LENGTHS_SWAPPED, CENTRE_SWAPPED, RECTIFIED = "focal_lengths_swapped", "centre_swapped", "rectified_image"
DISTORTION = "distortion_missing"
COMPENSATED, CLOCK_OFFSET = "already_compensated", "clock_offset"
BACKWARDS, MOTION_AXES, MOTION_UNIT = "motion_backwards", "motion_axes", "motion_unit"
TURNED_180, TURNED_90, MIRRORED = "image_turned_180", "image_turned_90", "image_mirrored"
IMAGE_SIZE, OFF_BY_ONE = "image_size", "off_by_one"

KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        INVERSE_POSE: Kind(
            0.3,
            "the inverse of the matrix",
            "T_camera_lidar is probably the pose of the camera in the LiDAR frame: write it under T_lidar_camera",
        ),
        INVERSE_ROTATION: Kind(
            0.02,
            "the transpose of the rotation",
            "the rotation of T_camera_lidar is probably that from camera to LiDAR, while its translation is not: "
            "transpose the rotation",
        ),
        INVERSE_TRANSLATION: Kind(
            0.1,
            "the translation read as the position of the other sensor",
            "the translation of T_camera_lidar is probably the position of the camera in the LiDAR frame: "
            "t = -R·position",
        ),
        TRANSLATION: Kind(
            0.1,
            "another translation",
            "the translation of T_camera_lidar is probably wrong: measure where the camera is, or estimate it with six "
            "degrees of freedom (--dof 6)",
        ),
        QUATERNION_ORDER: Kind(
            0.2,
            "the quaternion in the other order",
            "the quaternion was probably written w x y z and read as x y z w, or the other way round",
        ),
        CAMERA_AXES: Kind(
            0.2,
            "other axes of the camera",
            "the pose is probably that of a camera frame with x forward; coec's camera frame is optical: x right, "
            "y down, z forward",
        ),
        INVERSE_AND_AXES: Kind(
            0.15,
            "the inverse of the matrix, and other axes of the camera",
            "the matrix is probably the pose of the camera body (x forward) in the LiDAR frame; T_camera_lidar maps "
            "LiDAR coordinates to the optical frame (x right, y down, z forward)",
        ),
        LIDAR_AXES: Kind(
            0.1,
            "other axes of the LiDAR",
            "the pose probably belongs to a LiDAR frame with other axes than the cloud: turn T_camera_lidar on the "
            "LiDAR's side",
        ),
        POSE_UNIT: Kind(
            0.1,
            "the translation in another unit",
            "the translation of T_camera_lidar is probably not in metres",
        ),
        CLOUD_FRAME: Kind(
            0.1,
            "the pose read from the cloud's frame",
            "T_camera_lidar probably maps from the frame of the cloud (T_camera_cloud), or the other way round",
        ),
        FOCAL_LENGTH: Kind(0.1, "another focal length", "fx and fy are probably of another lens or another image size"),
        IMAGE_SCALE: Kind(
            0.2,
            "the intrinsics of another image size",
            "the intrinsics are probably those of an image of another size: scale fx, fy, cx and cy with it",
        ),
        PRINCIPAL_POINT: Kind(
            0.1,
            "another principal point",
            "cx and cy are probably those of another image: adapt them to the crop",
        ),
        FOCAL_LENGTHS_SWAPPED: Kind(0.05, "fx and fy exchanged", "fx and fy are probably exchanged"),
        CENTRE_SWAPPED: Kind(0.5, "cx and cy exchanged", "cx and cy are probably exchanged"),
        RECTIFIED: Kind(
            0.05,
            "no distortion",
            "the images are probably rectified already: use the intrinsics of the rectified image, without distortion",
        ),
        DISTORTION: Kind(
            0.1,
            "a distortion of the lens",
            "the images are probably not rectified, and the intrinsics have no distortion: calibrate the lens, or give "
            "the model and the distortion of its calibration",
        ),
        TURNED_180: Kind(
            0.1,
            "the images turned by 180°",
            "the images are probably upside down against the pose: turn them, or turn T_camera_lidar and the "
            "principal point",
        ),
        TURNED_90: Kind(
            0.05,
            "the images turned by 90°",
            "the images are probably turned by 90° against the pose: turn them, or T_camera_lidar and the intrinsics",
        ),
        COMPENSATED: Kind(
            0.1,
            "the clouds as they are",
            "the clouds are probably motion-compensated already: run with --no-motion-compensation, or without twist",
        ),
        BACKWARDS: Kind(
            0.05,
            "the motion backwards",
            "the velocities of the vehicle are probably given backwards, or in a frame that looks backwards: correct "
            "their sign, or the pose of their frame",
        ),
        MOTION_AXES: Kind(
            0.1,
            "the motion in other axes",
            "the velocities of the vehicle are probably given in a frame with other axes than the one that they name "
            "(x forward, y left, z up): correct the frame, or turn the velocities",
        ),
        MOTION_UNIT: Kind(
            0.1,
            "the motion in another unit",
            "the velocities of the vehicle are probably in km/h or in degrees per second: give m/s and rad/s",
        ),
        CLOCK_OFFSET: Kind(
            0.3,
            "other stamps of the clouds",
            "the stamps of camera and LiDAR are probably off: a frame late, or sweeps stamped at their end and not at "
            "their beginning, or the reverse",
        ),
        OFF_BY_ONE: Kind(
            0.1,
            "each image paired with the sweep before or after its own",
            "the images are probably listed, or stamped, a frame before or after their clouds: correct the list, or "
            "the stamps",
        ),
        MIRRORED: Kind(
            0.05,
            "the images mirrored",
            "the images are probably mirrored: have the camera's driver send them as they are, and flip those of this "
            "recording",
        ),
    }
)
"""The kinds of mistakes, by their codes."""

AS_GIVEN_ODDS = 20.0
"""Prior odds that the inputs are right, against any one mistake of odds 1."""

OPTICAL_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation from axes x forward, y left, z up to those of a camera: x right, y down, z forward (REP 103)."""

ZOOM_STEP = 1.08
"""Ratio of neighbouring focal lengths that are tried: at the edge of a 90° image 3° apart, half of what a turn of the
camera makes up for."""

ZOOMS = tuple(ZOOM_STEP**k for k in range(-9, 10) if abs(k) >= 2)
"""Ratios of the right focal length to the given one that are tried: from half to double. Errors of the lens below that
are found by the posterior (`uncertainty.posterior`)."""

SCALES = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0)
"""Ratios of the size of the image to that of the intrinsics."""

NOTICEABLE = 0.03
"""Share of the image by which a lens has to displace pixels to be tried. The posterior finds what is less."""

RECTIFIED_ZOOMS = (1.0, 0.85, 0.72, 0.61, 0.52)
"""Ratios of the focal length of a rectified image to that of the raw one, which may be less, to hold more of the
view."""

BARRELS = ((-0.35, 0.15), (-0.2, 0.04))
"""Radial terms k1 and k2 of common lenses: half of the view 45° and 30° wide."""

FISHEYES = ((0.0, 0.0, 0.0), (-1 / 24, 1 / 1920, -1 / 322_560), (1 / 12, 1 / 120, 17 / 20_160))
"""Terms k1 to k3 of the classical projections of fisheyes, as series in the angle θ from the optical axis: equidistant
(θ), equisolid (2·sin θ/2) and stereographic (2·tan θ/2)."""

LEAST_SCALE, OFF_MIDDLE = 0.1, 0.15
"""Least relative difference of the two sizes, and how far a principal point lies off the middle at most, as a share of
the image."""

LONG_TRANSLATION_M = 3.0
"""From this length on a translation may be in centimetres or millimetres."""

CROPS = (-0.24, -0.18, -0.12, -0.06, 0.06, 0.12, 0.18, 0.24)
"""Shifts of the principal point along one side that are tried, as a share of it: those of images whose crop is missing
in cx and cy."""

FARTHEST_OFF_MIDDLE = 0.3
"""How far a crop at one side leaves a principal point off the middle, as a share of that side."""

UNEQUAL_FOCAL_LENGTHS = 0.1
"""Relative difference of fx and fy from which on their order matters."""


@dataclass(frozen=True, slots=True, eq=False)
class Supposition:
    """Inputs as they would be without one mistake.

    Attributes:
        code: of the mistake, see `KINDS`; `AS_GIVEN` without one.
        camera, T_camera_lidar: intrinsics and extrinsic (4, 4).
        mirrored: whether the images have to be mirrored left-right.
        also: code of a second mistake; empty without one.
    """

    code: str
    camera: Camera
    T_camera_lidar: Matrix4
    mirrored: bool = False
    also: str = ""


def suppositions(rig: Rig) -> list[Supposition]:
    """The inputs as they would be without each mistake."""
    given = Supposition(AS_GIVEN, rig.camera, rig.T_camera_lidar_nominal)
    poses = [replace(given, code=code, T_camera_lidar=T) for code, T in _poses(rig.T_camera_lidar_nominal)]
    if rig.cloud is not None:
        for T_cloud_lidar in (rig.cloud.T_cloud_lidar, se3.inverse(rig.cloud.T_cloud_lidar)):
            poses.append(replace(given, code=CLOUD_FRAME, T_camera_lidar=given.T_camera_lidar @ T_cloud_lidar))
    lenses = (replace(given, code=code, camera=camera) for code, camera in _lenses(rig.camera))
    return [*poses, *_of_images(given), *lenses]


def suppositions_of_two(rig: Rig) -> list[Supposition]:
    """The inputs as they would be without two mistakes: one of the common ones in the pose, and one in the images or in
    their size."""
    pairs = []
    for code, T in _poses(rig.T_camera_lidar_nominal):
        if code in (INVERSE_POSE, QUATERNION_ORDER, CAMERA_AXES, INVERSE_AND_AXES):
            first = Supposition(code, rig.camera, T)
            scales = (replace(first, code=IMAGE_SCALE, camera=camera) for camera in _scaled(rig.camera))
            zooms = (replace(first, code=FOCAL_LENGTH, camera=zoomed(rig.camera, zoom)) for zoom in ZOOMS[::2])
            # What is turned by 90° as well is rare, and fits by chance.
            seconds = (*(one for one in _of_images(first) if one.code != TURNED_90), *scales, *zooms)
            pairs += [replace(both, code=code, also=both.code) for both in seconds]
    return pairs


QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation by 90° about z."""

OTHER_AXES = (QUARTER_TURN, QUARTER_TURN.T, OPTICAL_FROM_BODY, OPTICAL_FROM_BODY.T)
"""Rotations from axes in which vectors are given to those in which they are meant."""


def _turn(rotation: NDArray[np.float64]) -> Matrix4:
    return se3.transform_from(rotation, np.zeros(3))


def _about(axis: int, quarters: int) -> Matrix4:
    """A turn about an axis by so many quarters of a circle."""
    return _turn(np.rint(se3.rotation_exp(0.5 * np.pi * quarters * np.eye(3)[axis])))


def _poses(T: Matrix4) -> Iterator[tuple[str, Matrix4]]:
    rotation, translation, inverse = T[:3, :3], T[:3, 3], se3.inverse(T)
    yield INVERSE_POSE, inverse
    yield INVERSE_ROTATION, se3.transform_from(rotation.T, translation)
    yield INVERSE_TRANSLATION, se3.transform_from(rotation, inverse[:3, 3])
    yield INVERSE_TRANSLATION, se3.transform_from(rotation, -rotation @ translation)
    quaternion = se3.quaternion_xyzw_from_rotation(rotation)
    for turned in (1, -1):
        read = se3.rotation_from_quaternion_xyzw(np.roll(quaternion, turned))
        yield QUATERNION_ORDER, se3.transform_from(read, translation)
    for axes in (OPTICAL_FROM_BODY, OPTICAL_FROM_BODY.T):
        yield CAMERA_AXES, _turn(axes) @ T
        yield INVERSE_AND_AXES, _turn(axes) @ inverse
        yield LIDAR_AXES, T @ _turn(axes)
    for quarters in (1, 2, 3):
        yield LIDAR_AXES, T @ _about(2, quarters)
    for axis in (0, 1):
        yield LIDAR_AXES, T @ _about(axis, 2)
    if float(np.linalg.norm(translation)) >= LONG_TRANSLATION_M:
        for unit_m in (0.01, 0.001):
            yield POSE_UNIT, se3.transform_from(rotation, unit_m * translation)


def _of_images(given: Supposition) -> Iterator[Supposition]:
    """The images turned or mirrored. A turned image is that of a turned camera with another principal point."""
    camera, T = given.camera, given.T_camera_lidar
    right, bottom = camera.width - 1.0 - camera.cx, camera.height - 1.0 - camera.cy
    upside_down = changed(camera, cx=right, cy=bottom)
    yield replace(given, code=TURNED_180, camera=upside_down, T_camera_lidar=_about(2, 2) @ T)
    turned = changed(camera, fx=camera.fy, fy=camera.fx, cx=camera.cy, cy=camera.cx)
    for quarters in (1, 3):
        # The intrinsics are those of the images after they were turned, or before.
        for lens in (camera, turned) if off_middle(turned) <= OFF_MIDDLE else (camera,):
            yield replace(given, code=TURNED_90, camera=lens, T_camera_lidar=_about(2, quarters) @ T)
    yield replace(given, code=MIRRORED, mirrored=True)
    # Mirrored top-bottom: mirrored left-right and turned by 180°.
    yield replace(given, code=MIRRORED, camera=upside_down, T_camera_lidar=_about(2, 2) @ T, mirrored=True)


def off_middle(camera: Camera) -> float:
    """How far the principal point is off the middle of the image, as a share of the image."""
    right, down = camera.cx - 0.5 * (camera.width - 1.0), camera.cy - 0.5 * (camera.height - 1.0)
    return max(abs(right) / camera.width, abs(down) / camera.height)


def _scaled(camera: Camera) -> Iterator[Camera]:
    """The intrinsics for other sizes of the image, with which the principal point is about in the middle."""
    # Its place shows the size of the image that the intrinsics belong to.
    of_centre = camera.width / (2.0 * camera.cx + 1.0) if camera.cx > 0.0 else 1.0
    usual = min(SCALES, key=lambda scale: abs(scale / of_centre - 1.0))
    for scale in (*SCALES, *([] if abs(usual / of_centre - 1.0) < LEAST_SCALE else [of_centre])):
        right, down = scale * (camera.cx + 0.5) - 0.5, scale * (camera.cy + 0.5) - 0.5
        other = changed(camera, fx=scale * camera.fx, fy=scale * camera.fy, cx=right, cy=down)
        if abs(scale - 1.0) > LEAST_SCALE and off_middle(other) <= OFF_MIDDLE:
            yield other


def _lenses(camera: Camera) -> Iterator[tuple[str, Camera]]:
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    middle = (0.5 * (camera.width - 1.0), 0.5 * (camera.height - 1.0))
    for zoom in ZOOMS:
        yield FOCAL_LENGTH, zoomed(camera, zoom)
    for other in _scaled(camera):
        yield IMAGE_SCALE, other
    if off_middle(camera) > NOTICEABLE:
        yield PRINCIPAL_POINT, changed(camera, cx=middle[0], cy=middle[1])
    for share in CROPS:
        right, down = cx + share * camera.width, cy + share * camera.height
        if abs(right - middle[0]) <= FARTHEST_OFF_MIDDLE * camera.width:
            yield PRINCIPAL_POINT, changed(camera, cx=right)
        if abs(down - middle[1]) <= FARTHEST_OFF_MIDDLE * camera.height:
            yield PRINCIPAL_POINT, changed(camera, cy=down)
    swapped = changed(camera, cx=cy, cy=cx)
    if NOTICEABLE < off_middle(camera) > 2.0 * off_middle(swapped):
        yield CENTRE_SWAPPED, swapped
    if abs(fx / fy - 1.0) >= UNEQUAL_FOCAL_LENGTHS:
        yield FOCAL_LENGTHS_SWAPPED, changed(camera, fx=fy, fy=fx)
    pinhole = _undistorted(camera)
    ray = (0.4 * camera.width / pinhole.fx, 0.0, 1.0)
    displaced_px = cameras.project_point(camera, *ray)[0] - cameras.project_point(pinhole, *ray)[0]
    if abs(displaced_px) > NOTICEABLE * camera.width:
        for zoom in RECTIFIED_ZOOMS:
            yield RECTIFIED, zoomed(pinhole, zoom)
    else:
        of_pinhole = cameras.intrinsics_of(pinhole)
        for k1, k2, k3 in FISHEYES:
            yield DISTORTION, cameras.build("kannala_brandt", **of_pinhole, k1=k1, k2=k2, k3=k3, k4=0.0)
        for k1, k2 in BARRELS:
            yield DISTORTION, cameras.build("radtan", **of_pinhole, k1=k1, k2=k2, k3=0.0, p1=0.0, p2=0.0)


def _undistorted(camera: Camera) -> Camera:
    """The pinhole camera that agrees with a camera next to the optical axis."""
    off = 1e-4
    fx = (cameras.project_point(camera, off, 0.0, 1.0)[0] - camera.cx) / off
    fy = (cameras.project_point(camera, 0.0, off, 1.0)[1] - camera.cy) / off
    size = {"width": camera.width, "height": camera.height}
    return cameras.build("pinhole", **size, fx=fx, fy=fy, cx=camera.cx, cy=camera.cy)


def zoomed(camera: Camera, zoom: float) -> Camera:
    """The camera with so many times its focal length."""
    return changed(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)


def changed(camera: Camera, **intrinsics: float) -> Camera:
    """The camera with other values of some intrinsics."""
    return cameras.build(cameras.name_of(camera), **cameras.intrinsics_of(camera) | intrinsics)
