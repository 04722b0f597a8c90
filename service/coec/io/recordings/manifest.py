"""`dataset.yaml`: images and clouds listed one by one (CONTRACT, "Command line"); and the same file without a mistake
that was found in it.

The coordinate frames are called `camera` and `lidar`. A `twist` is the velocity of the LiDAR in its own frame at the
stamp of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node

from coec import config
from coec.calibration import types
from coec.calibration.frames import evidence
from coec.calibration.frames.lidar_origin import ApparentOrigin, SeveralOrigins
from coec.calibration.search.mistakes import INVERSE_POSE
from coec.config.model import ConfigModel
from coec.config.pair import Pose, with_direction
from coec.errors import ConfigError, DecodeError, OutputError, SourceError, UsageError
from coec.geometry import cameras, se3
from coec.geometry.cameras import Camera
from coec.io.frame_validation import raw_image
from coec.io.images import encode_depth_png, probe
from coec.io.intrinsics_files import cameras_of, load_camera_document, with_camera
from coec.io.numpy_files import read_npy
from coec.io.recordings import bag_recognition, recording_source
from coec.io.recordings.cloud_files import MAX_COLUMNS, CloudLayout, load_cloud, measured_from
from coec.io.recordings.kitti import load_image
from coec.io.rig_files import camera_of, load_mask
from coec.io.user_files import read_bytes, write_output

FILE_NAME = "dataset.yaml"
CAMERA_FRAME = "camera"
LIDAR_FRAME = "lidar"
CLOUD_FRAME = "cloud"

_MAX_STAMP_NS = 2**31 * 1_000_000_000
"""Bound for stamps: ROS 2 time, in which frames are recorded, has signed 32-bit seconds."""

_DEPTH_CODES = 65_534
"""Span of the codes 1 ... 65535 that mean a value in a 16-bit PNG; 0 means "no value"."""


class TwistDocument(ConfigModel):
    """Velocity of the LiDAR in its own frame, m/s and rad/s."""

    linear_mps: tuple[float, float, float]
    angular_radps: tuple[float, float, float]


class FrameDocument(ConfigModel):
    """One image and its cloud; paths are relative to the manifest."""

    image: config.FilePath
    cloud: config.FilePath
    stamp_ns: int = Field(ge=0, lt=_MAX_STAMP_NS)
    cloud_stamp_ns: int | None = Field(default=None, ge=0, lt=_MAX_STAMP_NS)
    depth: config.FilePath | None = None
    twist: TwistDocument | None = None


class ManifestDocument(ConfigModel):
    """The whole of `dataset.yaml`."""

    pair: config.Name
    camera: config.CameraIntrinsics
    mask: config.FilePath | None = None
    T_camera_lidar: Pose
    T_cloud_lidar: Pose = Field(
        default=config.IDENTITY, description="pose of the LiDAR in the frame in which the points are given"
    )
    cloud_columns: tuple[Annotated[str, Field(max_length=64)], ...] = Field(
        default=(),
        max_length=MAX_COLUMNS,
        description="names of the columns of .bin and .npy, _ for one that is unused",
    )
    cloud_time: config.PointTimeConfig | None = Field(
        default=None, description="how the points of .pcd, .ply, .bin and .npy are timed, if their values leave it open"
    )
    compensated: Literal[False, "no", "stamp", "begin", "middle", "end"] | None = Field(
        default=None,
        description="instant of the sweep for which points were compensated for motion before they were written",
    )
    frames: tuple[FrameDocument, ...] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _with_direction(cls, document: Any) -> Any:
        return with_direction(document)

    @field_validator("cloud_columns")
    @classmethod
    def _with_places(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if names and (not {"x", "y", "z"} <= set(names) or len(set(names) - {"_"}) < len(names) - names.count("_")):
            raise ValueError("has to name x, y and z, and no column twice")
        return names


def open_manifest(spec: recording_source.SourceSpec) -> recording_source.FramewiseRecording:
    """Opens a folder with a `dataset.yaml`, or such a file.

    Raises:
        UsageError: a query was given.
        SourceError: the manifest is absent or not YAML, has an unknown or missing key, or names an absent file; names
            each place.
    """
    spec.only()
    path = spec.path / FILE_NAME if spec.path.is_dir() else spec.path
    if not path.is_file():
        layouts = "kitti360:..., kitti-raw:... or kitti-odometry:..."
        raise SourceError(
            f"{spec.path} has neither a {FILE_NAME} nor files of a bag (.mcap, .db3, .bag); for a KITTI folder write "
            f"{layouts}"
        )
    document, camera, mask = _read(path)
    T_camera_lidar = np.array(document.T_camera_lidar, dtype=np.float64)
    T_cloud_lidar = np.array(document.T_cloud_lidar, dtype=np.float64)
    rig = types.Rig(
        pair=document.pair,
        camera=camera,
        camera_frame=CAMERA_FRAME,
        lidar_frame=LIDAR_FRAME,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4),
        mask=mask,
        cloud=None if np.array_equal(T_cloud_lidar, np.eye(4)) else types.CloudFrame(CLOUD_FRAME, T_cloud_lidar),
    )
    frames = sorted(document.frames, key=lambda frame: frame.stamp_ns)
    _check_frames(path, frames)
    depths = [path.parent / frame.depth for frame in frames if frame.depth is not None]
    scale = _DepthScale([depth for depth in depths if depth.suffix == ".npy"])
    layout = CloudLayout(document.cloud_columns, document.cloud_time)
    motions = [
        types.EgoMotion(frame.stamp_ns, LIDAR_FRAME, frame.twist.linear_mps, frame.twist.angular_radps)
        for frame in frames
        if frame.twist is not None
    ]
    recording = recording_source.FramewiseRecording(
        f"{path.parent.name}/{document.pair}",
        rig,
        T_camera_lidar,
        tuple(_recorded(path.parent, frame, scale, T_cloud_lidar, layout) for frame in frames),
        tuple(motions),
    )
    if document.compensated is None:
        instant, recognition = _compensated(recording)
    else:  # YAML 1.1 reads `no` as false
        instant, recognition = document.compensated or "no", None
    if instant in (None, "no"):
        return recording
    return replace(
        recording,
        frames=tuple(replace(frame, load_lidar=partial(_at, frame.load_lidar, instant)) for frame in recording.frames),
        recognitions=() if recognition is None else (recognition,),
    )


def _read(path: Path) -> tuple[ManifestDocument, Camera, NDArray[np.bool_] | None]:
    """The document of a manifest, its camera, and the mask that it names."""
    try:
        text, _ = load_camera_document(path)
    except ConfigError as error:
        raise SourceError(str(error)) from error
    if cameras_of(text, (1, 1)):
        raise SourceError(
            f"{path} holds the intrinsics of a camera, not a list of frames: name it as `camera: {path.name}` "
            f"in a {FILE_NAME}, or behind a bag as BAG?intrinsics={path.name}"
        )
    if isinstance(text, dict) and "pairs" in text and "frames" not in text:
        raise SourceError(f"{path} is the configuration of a service (`coec run --config`), not a {FILE_NAME}")
    try:
        document = ManifestDocument.model_validate(with_camera(text, path))
        camera = camera_of(document.camera)
        mask = None if document.mask is None else load_mask(path.parent / document.mask, camera)
    except ValidationError as error:
        raise SourceError(f"{path}: {config.describe(error)}") from error
    except ConfigError as error:
        raise SourceError(f"{path}: {error}") from error
    return document, camera, mask


def _compensated(recording: recording_source.FramewiseRecording) -> tuple[str | None, types.Recognition | None]:
    """See `bag_recognition.compensated`, of some sweeps at which the vehicle is known to drive."""
    driving = {m.stamp_ns for m in recording.motions if m.reaches(evidence.LEAST_SPEED_MPS)}
    moving = [frame for frame in recording.frames if frame.camera_stamp_ns in driving]
    sampled = [moving[index] for index in recording_source.evenly_spread(len(moving), bag_recognition.SAMPLED_SWEEPS)]
    sweeps = (frame.load_lidar() for frame in sampled)
    return bag_recognition.compensated(sweeps, recording.motions, np.eye(4), "`compensated: no` in the dataset.yaml")


def _at(load: Callable[[], types.LidarFrame], instant: str) -> types.LidarFrame:
    return bag_recognition.as_compensated(load(), instant)


def _check_frames(path: Path, frames: Sequence[FrameDocument]) -> None:
    stamps_ns = [frame.stamp_ns for frame in frames]
    if len(frames) > 1 and len(set(stamps_ns)) == 1:
        raise SourceError(
            f"{path}: all {len(frames)} frames have the stamp_ns {stamps_ns[0]}: write when each was taken, in "
            "nanoseconds; if only the rate is known, number them: 0, 100000000, 200000000, ... at 10 Hz"
        )
    unit = _unit_of(stamps_ns)
    if unit is not None:
        name, factor = unit
        raise SourceError(
            f"{path}: stamp_ns counts nanoseconds, and {stamps_ns[0]} with the next after "
            f"{stamps_ns[1] - stamps_ns[0]} looks like {name}: multiply every stamp by {factor}"
        )
    for stream in (stamps_ns, [_cloud_stamp_ns(f) for f in frames]):
        if any(later <= earlier for earlier, later in pairwise(stream)):
            raise SourceError(
                f"{path}: two frames have the same stamp, or clouds are not in the order of their images: correct "
                "stamp_ns and cloud_stamp_ns, or leave out the frame that stands there twice"
            )
    for frame in frames:
        for file in (frame.image, frame.cloud, frame.depth):
            if file is not None and not (path.parent / file).is_file():
                raise SourceError(f"{path}: there is no file {file}")
        if frame.depth is not None and frame.depth.suffix not in (".png", ".npy"):
            raise SourceError(f"{path}: depth {frame.depth} is neither .png nor .npy")


def _unit_of(stamps_ns: Sequence[int]) -> tuple[str, int] | None:
    """The unit in which stamps were written by mistake, and its factor; None if they can be nanoseconds. No camera
    takes a thousand pictures a second, and stamps of an epoch tell their unit by their size."""
    if len(stamps_ns) < 2 or float(np.median(np.diff(stamps_ns))) >= 1e6:
        return None
    units = ((10**9, 10**11, "seconds", 10**9), (10**12, 10**14, "milliseconds", 10**6), (10**15, 10**17, "µs", 10**3))
    return next(((name, factor) for least, most, name, factor in units if least <= stamps_ns[0] < most), None)


def _cloud_stamp_ns(frame: FrameDocument) -> int:
    return frame.stamp_ns if frame.cloud_stamp_ns is None else frame.cloud_stamp_ns


def _recorded(
    folder: Path, frame: FrameDocument, scale: _DepthScale, T_cloud_lidar: types.Matrix4, layout: CloudLayout
) -> recording_source.RecordedFrame:
    cloud_stamp_ns = _cloud_stamp_ns(frame)
    return recording_source.RecordedFrame(
        frame.stamp_ns,
        partial(_load_camera, folder, frame, scale),
        cloud_stamp_ns,
        partial(_load_lidar, folder / frame.cloud, cloud_stamp_ns, T_cloud_lidar, layout),
    )


_ADVICE = {
    ApparentOrigin.cause: "State the LiDAR's pose there as `T_cloud_lidar`.",
    SeveralOrigins.cause: "Give the cloud of one LiDAR only.",
}


def _load_lidar(path: Path, stamp_ns: int, T_cloud_lidar: types.Matrix4, layout: CloudLayout) -> types.LidarFrame:
    return measured_from(load_cloud(stamp_ns, LIDAR_FRAME, path, layout), T_cloud_lidar, LIDAR_FRAME, path, _ADVICE)


def _load_camera(folder: Path, frame: FrameDocument, scale: _DepthScale) -> types.CameraFrame:
    depth = None
    if frame.depth is not None:
        file = folder / frame.depth
        depth = scale.encode(file) if file.suffix == ".npy" else load_image(file)
    return types.CameraFrame(frame.stamp_ns, CAMERA_FRAME, _load_any_image(folder / frame.image), depth=depth)


def _load_any_image(path: Path) -> types.EncodedImage:
    """JPEG and PNG files as they are; any other image that OpenCV can read as raw 8-bit pixels."""
    data = read_bytes(path)
    try:
        return probe(data, config.LimitsConfig())
    except DecodeError as error:
        if error.reason != "image_unknown_format":
            raise SourceError(f"{path}: {error}") from error
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # an empty file, or a size that it refuses
        pixels = None
    if pixels is None:
        raise SourceError(f"{path} is not an image that OpenCV reads")
    height, width = pixels.shape[:2]
    return raw_image(types.ImageFormat.BGR8, width, height, pixels.tobytes(), config.LimitsConfig())


class _DepthScale:
    """One linear scale from the float maps of a recording to 16-bit codes 1 ... 65535, so that a code means the same in
    every frame. Values that are not finite or not above zero get 0, which means "no value". The scale keeps the order
    of the values up to 1/65534 of their span, and mutual information depends only on their order."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._least, self._span = 0.0, 0.0
        extremes = []
        for path in paths:
            values = _load_float_map(path)
            valid = values[_has_value(values)]
            if valid.size:
                extremes.append((float(valid.min()), float(valid.max())))
        if extremes:
            self._least = min(least for least, _ in extremes)
            self._span = max(greatest for _, greatest in extremes) - self._least

    def encode(self, path: Path) -> types.EncodedImage:
        """The map as a 16-bit grey PNG.

        Raises:
            SourceError: the file is unreadable or not a (h, w) array of floats.
        """
        values = _load_float_map(path)
        share = (np.where(_has_value(values), values, self._least) - self._least) / (self._span or 1.0)
        codes = np.where(_has_value(values), 1 + np.rint(np.clip(share, 0.0, 1.0) * _DEPTH_CODES), 0)
        return probe(encode_depth_png(codes.astype(np.uint16)), config.LimitsConfig())


def _has_value(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values) & (values > 0))


def _load_float_map(path: Path) -> NDArray[np.floating]:
    values = read_npy(path)
    if values.ndim != 2 or values.dtype.kind != "f" or not values.size:
        raise SourceError(f"{path}: a depth map must be a float array of shape (height, width)")
    if values.size > config.LimitsConfig().max_image_pixels:
        raise SourceError(f"{path}: {values.shape} is larger than any depth map")
    return np.asarray(values, dtype=np.float64)


DIGITS = 9
"""Decimal places of a matrix, as `coec calibrate` prints one."""

OTHER_DIRECTION = {"T_camera_lidar": "T_lidar_camera", "T_lidar_camera": "T_camera_lidar"}


# --- the file without a mistake ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Correction:
    """A corrected manifest, and what was changed in it, one sentence each."""

    path: Path
    changes: tuple[str, ...]


def manifest_of(source: str) -> Path:
    """The manifest that a SOURCE argument names.

    Raises:
        UsageError: it names no manifest, so that nothing can be corrected.
    """
    if not has_manifest(source):
        raise UsageError(f"--fix writes a corrected {FILE_NAME}, and {source} has none")
    path = recording_source.parse_spec(source).path
    return path / FILE_NAME if path.is_dir() else path


def has_manifest(source: str) -> bool:
    """Whether a SOURCE argument names a manifest, or a folder with one."""
    spec = recording_source.parse_spec(source)
    is_manifest = spec.path.suffix in (".yaml", ".yml") or (spec.path / FILE_NAME).is_file()
    return spec.layout is None and not recording_source.is_bag(spec) and is_manifest


def write_corrected(path: Path, mistake: types.Mistake, camera: Camera, T_camera_lidar: types.Matrix4) -> Correction:
    """Writes `NAME.fixed.yaml` next to a manifest. `camera` and `T_camera_lidar` (4, 4) are what the manifest gives.

    Raises:
        OutputError: no entry of the manifest corrects the mistake, or another file of that name exists.
        SourceError: the manifest cannot be read.
    """
    if not mistake.correctable:
        raise OutputError(f"no entry of {path} corrects this: {mistake.text}")
    text = _text(path)
    edits: list[tuple[int, int, str]] = []
    changes: list[str] = []
    root = _root(text, path)
    for key, value in root.value:
        name = key.value
        if name in (*OTHER_DIRECTION, "T_camera_cloud") and not np.array_equal(mistake.T_camera_lidar, T_camera_lidar):
            edit, change = _pose_edit(key, value, mistake)
        elif name == "camera" and mistake.camera != camera:
            edit, change = _camera_edits(value, camera, mistake.camera)
        else:
            continue
        edits += edit
        changes.append(change)
    for begin, end, replacement in sorted(edits, reverse=True):
        text = text[:begin] + replacement + text[end:]
    corrected = path.with_name(f"{path.stem}.fixed{path.suffix}")
    if corrected.exists() and _text(corrected) != text:
        raise OutputError(f"{corrected} exists and is another: move it away first")
    write_output(corrected, text.encode())
    try:
        config.load_yaml(corrected)
    except ConfigError as error:
        corrected.unlink()
        raise OutputError(f"{path} cannot be corrected without changing its form: {error}") from error
    return Correction(corrected, tuple(changes))


def _text(path: Path) -> str:
    try:
        return read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not UTF-8 text") from error


def _root(text: str, path: Path) -> MappingNode:
    try:
        root: Any = YAML().compose(text)
    except YAMLError as error:
        raise SourceError(f"{path} is not valid YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(root, MappingNode):
        raise SourceError(f"{path} holds no map of names")
    return root


def _pose_edit(key: Node, value: Node, mistake: types.Mistake) -> tuple[list[tuple[int, int, str]], str]:
    name = key.value
    if mistake.code == INVERSE_POSE and name in OTHER_DIRECTION:
        other = OTHER_DIRECTION[name]
        return [(key.start_mark.index, key.end_mark.index, other)], f"{name} is called {other}, with the same numbers"
    rows = [", ".join(f"{number + 0.0:.{DIGITS}f}" for number in row) for row in _orthonormal(mistake.T_camera_lidar)]
    lines = "".join(f"\n  - [{row}]" for row in rows)
    return [(key.start_mark.index, _end(value), f"T_camera_lidar:{lines}")], f"{name} is replaced by another pose"


def _orthonormal(T: types.Matrix4) -> types.Matrix4:
    """The pose with a rotation that is exact to rounding."""
    unit = se3.rotation_from_quaternion_xyzw(se3.quaternion_xyzw_from_rotation(T[:3, :3]))
    return se3.transform_from(unit, T[:3, 3])


def _camera_edits(value: Node, given: Camera, right: Camera) -> tuple[list[tuple[int, int, str]], str]:
    model = cameras.name_of(right)
    before, after = cameras.intrinsics_of(given), cameras.intrinsics_of(right)
    changed = {name: number for name, number in after.items() if before.get(name) != number}
    if isinstance(value, MappingNode) and model == cameras.name_of(given):
        places = {key.value: number for key, number in value.value}
        if changed.keys() <= places.keys():
            edits = [(places[n].start_mark.index, places[n].end_mark.index, _number(v)) for n, v in changed.items()]
            return edits, f"camera: {', '.join(f'{name} = {_number(number)}' for name, number in changed.items())}"
    entries = ", ".join(f"{name}: {_number(number)}" for name, number in after.items())
    # A map in block style begins on the next line.
    flow = f"{{model: {model}, {entries}}}"
    return [(value.start_mark.index, _end(value), flow)], f"camera: {flow}"


def _number(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.10g}"


def _end(node: Node) -> int:
    """The place behind a node. The end mark of a block lies behind the comments that follow it."""
    if isinstance(node, CollectionNode) and not node.flow_style and node.value:
        return max(_end(leaf) for leaf in _leaves(node))
    return int(node.end_mark.index)


def _leaves(node: CollectionNode) -> Iterator[Node]:
    for item in node.value:
        yield from item if isinstance(item, tuple) else (item,)
