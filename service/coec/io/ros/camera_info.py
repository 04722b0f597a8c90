"""Converts `sensor_msgs/CameraInfo` to the intrinsics of an image topic.

Which of the message's matrices apply depends on the topic: `K` and `d` belong to the image as the sensor gave it, `P`
to the rectified one (the message's definition). A lens of an unknown model, or a message that is no calibration, is
refused with a reason instead of guessing.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from pydantic import ValidationError
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import Recognition
from coec.config import CameraIntrinsics, describe
from coec.errors import DecodeError, SourceError
from coec.geometry import cameras
from coec.geometry.se3 import is_rigid, rotation_angle_rad, transform_from
from coec.io.frame_validation import MAX_FRAME_ID
from coec.io.rig_files import intrinsics_config
from coec.io.ros.message_encoding import DISTORTION
from coec.io.ros.messages import deserialized

MAX_INFO_BYTES: Final = 16 * 1024
"""Largest message. A frame id, the name of a model, 14 coefficients and 33 numbers take less than 1 kB."""

MAX_COEFFICIENTS: Final = 14
"""Most coefficients in `d`, as in OpenCV's largest model."""

TURNED_DEG: Final = 0.01
"""A rectification that turns the camera by less than this counts as none; a tenth of a calibration's uncertainty."""

TRANSPORTS: Final = ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")
"""What image_transport appends to the topic of an image."""

MAX_SKEW_PX: Final = 0.01
"""Largest skew in `K`; less moves no pixel."""

_POLYNOMIAL: Final = ("", "plumb_bob", "rational_polynomial")
"""Names of OpenCV's polynomials, which are distinguished by their coefficients instead of these names."""

_ALIASES: Final = {
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "ds": "double_sphere",
    "cata": "mei",
    "none": "",
}
"""Other names in use: those of ROS 1, of Kalibr, of Foxglove, and of catadioptric calibrations."""


@dataclass(frozen=True, slots=True)
class CameraInfoContent:
    """Content of a `CameraInfo`: `frame_id` of its header; `size` (width, height) of the full image, px; `d` (N,); `k`
    (9,), `r` (9,) and `p` (12,) by rows; `binning` (x, y), at least 1; `roi` (x, y, width, height), px."""

    frame_id: str
    size: tuple[int, int]
    model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    binning: tuple[int, int]
    roi: tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class CameraInfoIntrinsics:
    """Intrinsics, a short text that says which of the message's numbers they come from, and whether these were adapted
    to a part of the image, or to a binned one."""

    intrinsics: CameraIntrinsics
    source: str
    is_adapted: bool = False


MAX_CONTENTS: Final = 64
"""Most different contents of one topic that are kept. A driver that counts in a field of the message has more."""

SAME_PX: Final = 1.0
"""Matrices that differ by at most this are one lens, whose focus breathes."""


RARE: Final = 5
"""Contents that came once, a content so many times more often than all of them together, are damaged."""


class CameraInfos:
    """The camera infos of one topic: their different contents, and how often each came."""

    def __init__(self) -> None:
        self.count = 0
        self.empty = 0
        self._contents: Counter[CameraInfoContent] = Counter()
        self._latest: tuple[bytes, CameraInfoContent] | None = None

    def add(self, payload: bytes) -> None:
        """Notes one more message in CDR.

        Raises:
            DecodeError: the reasons of `decode_info`.
        """
        # Most drivers send the same again and again, with another stamp.
        body = payload[12:]
        content = decode_info(payload) if self._latest is None or self._latest[0] != body else self._latest[1]
        self._latest = body, content
        self.count += 1
        self.empty += content.k[0] == 0.0
        if content in self._contents or len(self._contents) < MAX_CONTENTS:
            self._contents[content] += 1

    def frames(self) -> set[str]:
        """The frames that the messages name."""
        return {content.frame_id for content in self._contents}

    def content(self, frames: Collection[str]) -> tuple[CameraInfoContent, tuple[Recognition, ...]]:
        """The content that holds: of those that name one of the `frames`, if there are any, the most frequent one; and
        what was left out.

        Raises:
            SourceError: the messages describe different lenses.
        """
        calibrated = {content: count for content, count in self._contents.items() if content.k[0] != 0.0}
        if not calibrated:
            return next(iter(self._contents)), ()
        recognised = []
        if self.empty:
            text = f"{self.empty} of {self.count} CameraInfo are empty (K is zero) and are left out."
            recognised.append(Recognition("camera_info_empty", text, "warn"))
        own = {content: count for content, count in calibrated.items() if content.frame_id in frames} or calibrated
        usual = max(own, key=own.__getitem__)
        once = [content for content, count in own.items() if count == 1]
        if 0 < len(once) <= own[usual] // RARE:
            own = {content: count for content, count in own.items() if count > 1}
            text = f"{len(once)} of {self.count} CameraInfo are unlike all others, probably damaged, and are left out."
            recognised.append(Recognition("camera_info_damaged", text, "warn"))
        difference_px = max(np.abs(np.subtract(content.k, usual.k)).max() for content in own)
        others = [c for c in own if replace(c, k=usual.k, p=usual.p, frame_id="") != replace(usual, frame_id="")]
        if not difference_px <= SAME_PX or others:
            other = max(own, key=lambda content: np.abs(np.subtract(content.k, usual.k)).max())
            raise SourceError(
                f"the CameraInfo changes on the way, between {_lens_text(usual)} and {_lens_text(other)}: let only one "
                "camera publish on the topic, and keep zoom and resolution as they are"
            )
        if difference_px > 0.0:
            text = (
                f"The CameraInfo changes by up to {difference_px:.2f} px on the way; its most frequent content is used."
            )
            recognised.append(Recognition("camera_info_changes", text, "warn"))
        return usual, tuple(recognised)


def _lens_text(info: CameraInfoContent) -> str:
    size = f"{info.size[0]} x {info.size[1]} px"
    return f"fx {info.k[0]:.1f}, cx {info.k[2]:.1f}, {size} of {info.frame_id!a}"


def decode_info(payload: bytes) -> CameraInfoContent:
    """The content of a message in CDR.

    Raises:
        DecodeError: not a `CameraInfo`, or larger than one can be.
    """
    if len(payload) > MAX_INFO_BYTES:
        raise DecodeError("message_too_large", f"a CameraInfo has at most {MAX_INFO_BYTES} bytes")
    return info_of(deserialized(ros.sensor_msgs__msg__CameraInfo, payload))


def info_of(message: Any) -> CameraInfoContent:
    """The content of a deserialised `CameraInfo`.

    Raises:
        DecodeError: a name or a list in it is longer than any driver writes.
    """
    if len(message.header.frame_id) > MAX_FRAME_ID or len(message.distortion_model) > MAX_FRAME_ID:
        raise DecodeError("frame_id_invalid", f"a name in a CameraInfo is longer than {MAX_FRAME_ID} characters")
    if len(message.d) > MAX_COEFFICIENTS:
        raise DecodeError("camera_info", f"a CameraInfo has at most {MAX_COEFFICIENTS} distortion coefficients")
    roi = message.roi
    d, k, r, p = (tuple(float(value) for value in numbers) for numbers in (message.d, message.k, message.r, message.p))
    return CameraInfoContent(
        message.header.frame_id,
        (int(message.width), int(message.height)),
        message.distortion_model,
        d,
        k,
        r,
        p,
        (max(int(message.binning_x), 1), max(int(message.binning_y), 1)),
        (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
    )


def info_of_yaml(document: object) -> CameraInfoContent | None:
    """The content of a YAML file with a `CameraInfo`: as ROS's camera_calibration writes it (`camera_matrix`), or as
    `ros2 topic echo` prints the message. None if it is neither.

    Raises:
        SourceError: it is one, and a number is absent or of the wrong form; says which.
    """
    if not isinstance(document, dict) or not ({"camera_matrix", "k", "K"} & document.keys()):
        return None

    def numbers(names: Sequence[str], count: int | None, default: Sequence[float] | None = None) -> tuple[float, ...]:
        value = next((document[name] for name in names if name in document), default)
        value = value.get("data") if isinstance(value, dict) else value
        try:
            values = tuple(float(number) for number in value or ())
        except (TypeError, ValueError, OverflowError) as error:
            raise SourceError(f"{names[0]} is no list of numbers") from error
        if count is not None and len(values) != count:
            raise SourceError(f"{names[0]} has {len(values)} numbers, not {count}")
        return values

    def whole(names: Sequence[str]) -> int:
        value = next((document[name] for name in names if name in document), None)
        if not isinstance(value, int) or value <= 0:
            raise SourceError(f"{names[0]} is missing, or is no positive number of pixels")
        return value

    d = numbers(("distortion_coefficients", "d", "D"), None)
    model = document.get("distortion_model", "plumb_bob")
    if len(d) > MAX_COEFFICIENTS or not isinstance(model, str):
        raise SourceError(f"a CameraInfo has the name of a model, and at most {MAX_COEFFICIENTS} coefficients")
    return CameraInfoContent(
        frame_id="",
        size=(whole(("image_width", "width")), whole(("image_height", "height"))),
        model=model,
        d=d,
        k=numbers(("camera_matrix", "k", "K"), 9),
        r=numbers(("rectification_matrix", "r", "R"), 9, np.eye(3).ravel().tolist()),
        p=numbers(("projection_matrix", "p", "P"), 12, np.zeros(12).tolist()),
        binning=(1, 1),
        roi=(0, 0, 0, 0),
    )


def info_topic(image_topic: str) -> str:
    """The topic of the `CameraInfo` for an image topic, by image_transport's rule: beside the image, for any
    transport."""
    namespace, _, last = image_topic.rstrip("/").rpartition("/")
    if last in TRANSPORTS and namespace.strip("/"):
        namespace = namespace.rpartition("/")[0]
    return f"{namespace}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Whether a topic holds rectified images, by the names that image_proc gives them (`image_rect`,
    `image_rect_color`)."""
    parts = [part for chunk in image_topic.split("/") for part in chunk.split("_")]
    return any(part in ("rect", "rectified") for part in parts)


def intrinsics_of_info(info: CameraInfoContent, *, rectified: bool) -> CameraInfoIntrinsics:
    """The lens of a raw or rectified image, at the size of the received image. `K` and `P` hold for the full image, of
    which `roi` is cut out and then binned. Pixel centres lie at integers, so that binning by b takes u to
    (u + 0.5)/b - 0.5.

    A message with a rectifying rotation `R` does not say whether its frame is that of the raw or of the rectified
    image. It is taken for the frame of the image in question, and `source` gives the angle.

    Raises:
        SourceError: uncalibrated, an unknown model, numbers that no lens has, or the second image of a stereo camera,
            which is described in the frame of the first.
    """
    if not all(np.isfinite(values).all() for values in (info.d, info.k, info.r, info.p)):
        raise SourceError("a number in it is not finite")
    if info.k[0] == 0.0:
        raise SourceError("the camera is uncalibrated: K is zero")
    model, matrix, distortion, source = _rectified(info) if rectified else _raw(info)
    (width, height), (x, y, cut_width, cut_height) = info.size, info.roi
    if cut_width or cut_height:
        if x + cut_width > width or y + cut_height > height:
            raise SourceError("its region of interest reaches beyond the image")
        width, height, source = cut_width, cut_height, f"{source}, cut to {cut_width} x {cut_height} px at ({x}, {y})"
    fx, fy, cx, cy = matrix
    try:
        size = {"width": width, "height": height}
        camera = cameras.build(model, **size, fx=fx, fy=fy, cx=cx - x, cy=cy - y, **distortion)
        if info.binning != (1, 1):
            camera = cameras.scaled(camera, 1.0 / info.binning[0], 1.0 / info.binning[1])
            source += f", binned {info.binning[0]} x {info.binning[1]}"
        is_adapted = info.binning != (1, 1) or bool(cut_width or cut_height)
        return CameraInfoIntrinsics(intrinsics_config(camera), source, is_adapted)
    except ValidationError as error:
        raise SourceError(describe(error)) from error
    except ValueError as error:
        raise SourceError(str(error)) from error


_LensParts = tuple[str, tuple[float, float, float, float], dict[str, float], str]
"""Model; fx, fy, cx, cy; distortion; text that says where they come from."""


def _rectified(info: CameraInfoContent) -> _LensParts:
    fx, _, cx, tx, _, fy, cy, ty = info.p[:8]
    if fx == 0.0:
        raise SourceError("the camera is uncalibrated for rectified images: P is zero")
    if tx != 0.0 or ty != 0.0:
        raise SourceError(
            f"P is of a stereo camera's second image, {abs(tx / fx):.3f} m beside the first, in whose frame it is; "
            "give camera.intrinsics and T_camera_lidar"
        )
    return "pinhole", (fx, fy, cx, cy), {}, "P, of the rectified image"


def _raw(info: CameraInfoContent) -> _LensParts:
    if abs(info.k[1]) > MAX_SKEW_PX:
        raise SourceError(f"K has a skew of {info.k[1]:g} px, which no camera model here has")
    name = _ALIASES.get(info.model, info.model)
    model, distortion = _polynomial(info.d) if name in _POLYNOMIAL else _named(name, info)
    source = f"K and d, {info.model or 'without a name'}"
    turned_deg = _turned_deg(info.r)
    if turned_deg > TURNED_DEG:
        source += f" (R turns by {turned_deg:.2f} deg, which is not applied)"
    return model, (info.k[0], info.k[4], info.k[2], info.k[5]), distortion, source


def _polynomial(d: Sequence[float]) -> tuple[str, dict[str, float]]:
    """The smallest of OpenCV's models that has all non-zero coefficients."""
    if 0 < len(d) < 4:
        raise SourceError(f"plumb_bob has four or five coefficients, rational_polynomial eight, this camera {len(d)}")
    names = DISTORTION["rational"][1]
    if any(d[len(names) :]):
        what = "a tilted sensor (tau)" if any(d[12:]) else "thin prisms (s1 to s4)"
        raise SourceError(f"{what} in d beyond its eighth: no camera model here has that; calibrate with eight")
    values = dict(zip(names, (*d, *(0.0,) * len(names)), strict=False))
    for model in ("pinhole", "radtan", "rational"):
        parameters = DISTORTION[model][1]
        if not any(value for name, value in values.items() if name not in parameters):
            return model, {name: values[name] for name in parameters}
    raise AssertionError("the last has every coefficient")


def _named(name: str, info: CameraInfoContent) -> tuple[str, dict[str, float]]:
    for model, (distortion, parameters) in DISTORTION.items():
        if distortion == name:
            if len(info.d) < len(parameters) or any(info.d[len(parameters) :]):
                raise SourceError(f"{info.model} has the parameters {' '.join(parameters)}; here are {len(info.d)}")
            return model, dict(zip(parameters, info.d, strict=False))
    known = ", ".join(sorted({distortion for distortion, _ in DISTORTION.values()} | set(_ALIASES) - {"none"}))
    raise SourceError(f"a distortion model of this name is not known ({known} are)")


def _turned_deg(r: Sequence[float]) -> float:
    """The angle of a rectifying rotation; 0 if none is given, or if the matrix is no rotation."""
    turn = transform_from(np.reshape(r, (3, 3)), np.zeros(3))
    return float(np.degrees(rotation_angle_rad(turn))) if is_rigid(turn) else 0.0
