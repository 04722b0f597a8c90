"""An extrinsic in the files of other programs: each function here that is registered by `_format` is a format.

Each writes the direction and the order that its readers expect, and states both in the file. In a file that can hold
several transforms, only this one is changed; a file of one transform is written anew. Of YAML the library (ruamel) only
finds the place of an entry, whose lines are replaced here: its own round trip keeps comments, quotes and numbers, but
wraps, indents and spaces the lists of the whole document anew.

The names of the formats stand in help texts, so that what takes long to import is imported in the functions.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from coec.errors import OutputError, SourceError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from ruamel.yaml.comments import CommentedMap

    from coec.calibration.types import Matrix4
    from coec.config import CameraIntrinsics
    from coec.io.exported_extrinsic import ExportedExtrinsic


class Format(NamedTuple):
    """How a file is written.

    Attributes:
        text: returns the new content of the file, given its present content (None: there is no file yet). Raises
            `OutputError` if that is not possible.
        encoding: of the text, as Zenoh names encodings.
    """

    text: Callable[[ExportedExtrinsic, str | None], str]
    encoding: str


FORMATS: dict[str, Format] = {}
"""All formats, by the names that a user writes."""

MAX_EXPORT_BYTES = 64 * 2**20
"""Largest file that is read or changed by an export, bytes. A robot's URDF has less than one million."""

JSON, PLAIN, YAML, XML = "application/json", "text/plain", "application/yaml", "application/xml"


def _format(name: str, encoding: str) -> Callable[[Callable[..., str]], Callable[..., str]]:
    def register(text: Callable[..., str]) -> Callable[..., str]:
        FORMATS[name] = Format(text, encoding)
        return text

    return register


def export_text(extrinsic: ExportedExtrinsic, form: str, path: Path | None) -> str:
    """The new text of the file `path` (None: there is none). Its present content stays where the format has room for
    it.

    Raises:
        UsageError: no such format.
        SourceError: the present file cannot be read, or is not text.
        OutputError: the present content cannot be changed.
    """
    require_format(form)
    return FORMATS[form].text(extrinsic, None if path is None else _present_text(path))


def require_format(form: str) -> None:
    """Returns if the format exists.

    Raises:
        UsageError: there is no such format; the message lists those that exist.
    """
    if form not in FORMATS:
        raise UsageError(f"format {form}: known are {', '.join(FORMATS)}")


def _present_text(path: Path) -> str | None:
    """Text of the file that is to be changed; None where there is no file."""
    from coec.io import user_files

    if not path.exists():
        return None
    try:
        return user_files.read_bytes(path, MAX_EXPORT_BYTES).decode()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} is not UTF-8 text: it cannot be changed") from error


@_format("autoware", YAML)
def _autoware(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """Autoware's `sensor_kit_calibration.yaml`: the pose of a camera's body frame (`<camera>/camera_link`) in the
    kit."""
    direction = (
        "pose in the parent of the camera's body frame (x forward, y left, z up); the optical frame is the body frame "
        "turned by the quaternion x y z w = -0.5 0.5 -0.5 0.5; rad, R = Rz(yaw) Ry(pitch) Rx(roll)"
    )
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    values = [*_translation_m(extrinsic.T_parent_body), *roll_pitch_yaw(extrinsic.T_parent_body)]
    lines = [
        *_comments(extrinsic, direction),
        *(f"{name}: {value!r}" for name, value in zip(names, values, strict=True)),
    ]
    return _with_yaml_entry(existing, (extrinsic.parent, extrinsic.child), lines)


@_format("colmap", JSON)
def _colmap(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """COLMAP's `rig_config.json`: the rigs with this camera, whose `image_prefix` is the child and a slash. It is put
    into the rig whose reference sensor is the parent, or into a new rig if there is none. Remarks are under `coec`,
    which its readers ignore.

    COLMAP accepts a rig only with a reference sensor, to which all poses of its cameras relate. Here it is the parent,
    under a prefix that no image has.
    """
    rigs = [] if existing is None else _parsed_json(existing)
    reference, prefix = f"{extrinsic.parent}/", f"{extrinsic.child}/"
    direction = "cam_from_rig maps the rig (the parent) to the optical camera frame; rotation w x y z"
    camera = {
        "image_prefix": prefix,
        "cam_from_rig_rotation": _quaternion_wxyz(extrinsic.T_child_parent),
        "cam_from_rig_translation": _translation_m(extrinsic.T_child_parent),
        "coec": extrinsic.document(direction),
    }
    try:
        for rig in rigs:
            references = [one["image_prefix"] for one in rig["cameras"] if one.get("ref_sensor")]
            same = [one for one in rig["cameras"] if one["image_prefix"] == prefix]
            if references == [reference]:
                if same:
                    same[0].update(camera)
                else:
                    rig["cameras"].append(camera)
                return _json_text(rigs)
            if same:
                raise OutputError(
                    f"camera {prefix!r} is in a rig whose reference is {references}: its pose there is not one from "
                    f"{reference!r}; write into another file, or name that reference with --parent and --parent-pose"
                )
        return _json_text([*rigs, {"cameras": [{"image_prefix": reference, "ref_sensor": True}, camera]}])
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no rig configuration of COLMAP") from error


@_format("json", JSON)
def _json(extrinsic: ExportedExtrinsic, _: str | None) -> str:
    """A document of our own: the transform in both directions and in three forms."""
    direction = "T_child_parent maps coordinates in the parent to the optical camera frame (z forward); row-major"
    document = {
        "parent": extrinsic.parent,
        "child": extrinsic.child,
        "T_child_parent": extrinsic.T_child_parent.tolist(),
        "pose_of_child_in_parent": {
            "translation_m": _translation_m(extrinsic.T_parent_child),
            "quaternion_xyzw": _quaternion_xyzw(extrinsic.T_parent_child),
        },
        "camera": None if extrinsic.camera is None else extrinsic.camera.model_dump(mode="json", exclude_none=True),
        **extrinsic.document(direction),
    }
    return _json_text(document)


@_format("kalibr", YAML)
def _kalibr(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """Kalibr's camera chain: intrinsics with `T_cam_lidar` beside them. Its entry has the name of the child frame if
    that has Kalibr's form (`cam0`), else `cam0`. Models: Kalibr's wiki, "Supported models"."""
    camera = _camera(extrinsic, "kalibr")
    name = extrinsic.child if re.fullmatch(r"cam\d+", extrinsic.child) else "cam0"
    direction = (
        "T_cam_lidar maps coordinates in the parent to the optical camera frame (z forward); rows of a 4x4 matrix"
    )
    model, intrinsics, distortion_model, distortion = _kalibr_camera(camera)
    lines = [
        *_comments(extrinsic, direction),
        f"camera_model: {model}",
        f"intrinsics: {intrinsics}",
        f"distortion_model: {distortion_model}",
        f"distortion_coeffs: {distortion}",
        f"resolution: [{camera.width}, {camera.height}]",
        "T_cam_lidar:",
        *(f"- {row}" for row in extrinsic.T_child_parent.tolist()),
    ]
    return _with_yaml_entry(existing, (name,), lines)


def _kalibr_camera(camera: CameraIntrinsics) -> tuple[str, list[float], str, list[float]]:
    """Kalibr's names and orders: camera model, its parameters, distortion model, its coefficients."""
    given = camera.parameters()
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    tangential = [given.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")]
    match camera.model:
        case "double_sphere":
            return "ds", [given["xi"], given["alpha"], *pinhole], "none", []
        case "eucm":
            return "eucm", [given["alpha"], given["beta"], *pinhole], "none", []
        case "mei":
            return "omni", [given["xi"], *pinhole], "radtan", tangential
        case "kannala_brandt":
            return "pinhole", pinhole, "equidistant", [given.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")]
        case "pinhole":
            return "pinhole", pinhole, "none", []
        case "radtan":
            if given.get("k3"):
                raise OutputError("Kalibr's radtan has no k3: this camera cannot be written for it")
            return "pinhole", pinhole, "radtan", tangential
        case _:
            raise OutputError(f"Kalibr has no {camera.model} distortion: this camera cannot be written for it")


@_format("kitti", PLAIN)
def _kitti(extrinsic: ExportedExtrinsic, _: str | None) -> str:
    """`calib_velo_to_cam.txt` of KITTI's raw recordings. Its readers treat lines that are no numbers as text, such as
    `calib_time`."""
    from coec.io.exported_extrinsic import utc

    T = extrinsic.T_child_parent
    direction = "R, T: p_camera = R p_velo + T, rows of R; velo is the parent, the camera unrectified"
    lines = [
        f"calib_time: {utc(extrinsic.origin.data_stamp_ns)}",
        f"R: {_number_row(T[:3, :3].ravel().tolist())}",
        f"T: {_number_row(T[:3, 3].tolist())}",
        *(f"coec_{number}: {comment}" for number, comment in enumerate(extrinsic.remarks(direction))),
    ]
    return _lines(lines)


@_format("kitti360", PLAIN)
def _kitti360(extrinsic: ExportedExtrinsic, _: str | None) -> str:
    """KITTI-360's `calib_cam_to_velo.txt`: comments, and one line of twelve numbers."""
    direction = "p_velo = M p_camera, three rows of M; velo is the parent, the camera unrectified"
    return _lines([*_comments(extrinsic, direction), _number_row(extrinsic.T_parent_child[:3].ravel().tolist())])


@_format("nuscenes", JSON)
def _nuscenes(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """nuScenes' table `calibrated_sensor.json` with the record of this sensor, whose `sensor_token` is the child frame.
    Remarks are under `coec`, which its readers ignore."""
    table = [] if existing is None else _parsed_json(existing)
    if not isinstance(table, list) or not all(isinstance(record, dict) for record in table):
        raise OutputError("the file is no table of nuScenes: a list of records is expected")
    camera = extrinsic.camera
    intrinsic = [] if camera is None else [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    direction = "pose of the child (optical: z forward) in the parent (nuScenes: ego); rotation w x y z"
    same = [record for record in table if record.get("sensor_token") == extrinsic.child]
    record = same[0] if same else {"token": hashlib.md5(extrinsic.child.encode(), usedforsecurity=False).hexdigest()}
    record.update(
        sensor_token=extrinsic.child,
        translation=_translation_m(extrinsic.T_parent_child),
        rotation=_quaternion_wxyz(extrinsic.T_parent_child),
        camera_intrinsic=intrinsic,
        coec=extrinsic.document(direction),
    )
    return _json_text(table if same else [*table, record])


@_format("opencv", YAML)
def _opencv(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """OpenCV's FileStorage (YAML 1.0) with a 4×4 matrix, named after its frames: it replaces the one of the same name,
    or is added at the end.

    YAML libraries cannot read FileStorage, so that the lines of the matrix are found by the way OpenCV writes them: a
    name at the margin, and indented lines below it.
    """
    name = re.sub(r"\W", "_", f"T_{extrinsic.child}_{extrinsic.parent}")
    data = ", ".join(map(repr, extrinsic.T_child_parent.ravel().tolist()))
    direction = "maps coordinates in the parent to the optical camera frame (z forward); row by row"
    below = [*_comments(extrinsic, direction), "rows: 4", "cols: 4", "dt: d", f"data: [ {data} ]"]
    block = _lines([f"{name}: !!opencv-matrix", *(f"   {line}" for line in below)])
    if existing is None:
        return "%YAML:1.0\n---\n" + block
    if not existing.startswith("%YAML"):
        raise OutputError("the file is none of OpenCV's: it does not begin with %YAML")
    pattern = re.compile(rf"^{re.escape(name)}:.*\n(?:[ \t]+.*\n)*", re.MULTILINE)
    whole = existing if existing.endswith("\n") else existing + "\n"
    return pattern.sub(lambda _: block, whole, count=1) if pattern.search(whole) else whole + block


@_format("openlabel", JSON)
def _openlabel(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """OpenLABEL's document with this coordinate system, and with its parent if that is missing. Remarks are under
    `coec`, which its readers ignore."""
    fresh: dict[str, Any] = {"openlabel": {"metadata": {"schema_version": "1.0.0"}, "coordinate_systems": {}}}
    document = fresh if existing is None else _parsed_json(existing)
    try:
        systems = document["openlabel"].setdefault("coordinate_systems", {})
        parent = systems.setdefault(extrinsic.parent, {"type": "local", "parent": "", "children": []})
        children = parent.setdefault("children", [])
        if extrinsic.child not in children:
            children.append(extrinsic.child)
        systems[extrinsic.child] = {
            **systems.get(extrinsic.child, {"type": "sensor", "children": []}),
            "parent": extrinsic.parent,
            "pose_wrt_parent": {
                "quaternion": _quaternion_xyzw(extrinsic.T_parent_child),
                "translation": _translation_m(extrinsic.T_parent_child),
            },
            "coec": extrinsic.document(POSE_XYZW),
        }
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no OpenLABEL document") from error
    return _json_text(document)


POSE_XYZW = "pose of the child (optical: z forward) in the parent; quaternion x y z w"
"""Direction in several formats."""


@_format("ros_camera_info", YAML)
def _ros_camera_info(extrinsic: ExportedExtrinsic, _: str | None) -> str:
    """ROS's `camera_info` YAML, as camera_calibration writes it and camera_info_manager reads it: the intrinsics that
    belong to the extrinsic, which stands in the comments. A lens that ROS does not know is written as `equidistant`, if
    that fits. Format: http://wiki.ros.org/camera_calibration_parsers."""
    from coec.geometry.cameras import intrinsics_of, name_of
    from coec.io.rig_files import camera_of
    from coec.io.ros.message_encoding import DISTORTION, UnsupportedCameraError, ros_camera

    try:
        camera, residual_px = ros_camera(camera_of(_camera(extrinsic, "ros_camera_info")))
    except UnsupportedCameraError as error:
        raise OutputError(str(error)) from error
    model, names = DISTORTION[name_of(camera)]
    parameters = intrinsics_of(camera)
    distortion = [float(parameters[name]) for name in names] or [0.0] * 5
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    place, turn = _translation_m(extrinsic.T_parent_child), _quaternion_xyzw(extrinsic.T_parent_child)
    matrices = (
        ("camera_matrix", 3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        ("distortion_coefficients", 1, len(distortion), distortion),
        ("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        ("projection_matrix", 3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    )
    lines = [
        *_comments(extrinsic, POSE_XYZW),
        f"# {extrinsic.child} in {extrinsic.parent}: translation {place}, quaternion {turn}",
        *([f"# the lens as equidistant, at most {residual_px:.2g} px off"] if residual_px > 0.0 else []),
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f'camera_name: "{extrinsic.child}"',
        f"distortion_model: {model}",
        *(f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {values}" for name, rows, columns, values in matrices),
    ]
    return _lines(lines)


@_format("tf", PLAIN)
def _tf(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """A shell script for tf2's `static_transform_publisher`, with one command per transform: that with the same child
    is replaced, or a new one is added at the end."""
    x, y, z = _translation_m(extrinsic.T_parent_child)
    qx, qy, qz, qw = _quaternion_xyzw(extrinsic.T_parent_child)
    child, mark = shlex.quote(extrinsic.child), "# coec: "
    fresh = [
        *(mark + comment for comment in extrinsic.remarks(POSE_XYZW)),
        f"ros2 run tf2_ros static_transform_publisher --x {x!r} --y {y!r} --z {z!r} "
        f"--qx {qx!r} --qy {qy!r} --qz {qz!r} --qw {qw!r} "
        f"--frame-id {shlex.quote(extrinsic.parent)} --child-frame-id {child} &",
    ]
    if existing is None:
        return _lines(["#!/bin/sh", *fresh, "wait"])
    lines = existing.splitlines()
    command = re.compile(rf"--child-frame-id {re.escape(child)}(\s|$)")
    at = next((number for number, line in enumerate(lines) if command.search(line)), None)
    if at is None:
        begin = end = len(lines) - 1 if lines and lines[-1].strip() == "wait" else len(lines)
    else:
        begin, end = at, at + 1
        while begin and lines[begin - 1].startswith(mark):
            begin -= 1
    return _lines([*lines[:begin], *fresh, *lines[end:]])


@_format("urdf", XML)
def _urdf(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """URDF (and xacro) with a fixed joint: it replaces the one with the same child link, or is added as the last one.
    Format: http://wiki.ros.org/urdf/XML/joint."""
    if existing is None:
        joint = _urdf_joint(extrinsic, f"{extrinsic.child}_joint")
        links = "".join(f"  <link name={quoteattr(name)}/>\n" for name in (extrinsic.parent, extrinsic.child))
        return f'<?xml version="1.0"?>\n<robot name="vehicle">\n{links}  {joint}\n</robot>\n'
    data = existing.encode()
    scan = _urdf_joints(data)
    same = next((joint for joint in scan.joints if joint.child == extrinsic.child), None)
    if same is None:
        fresh = _urdf_joint(extrinsic, f"{extrinsic.child}_joint").encode()
        return (data[: scan.root_end] + b"  " + fresh + b"\n" + data[scan.root_end :]).decode()
    return (data[: same.begin] + _urdf_joint(extrinsic, same.name).encode() + data[same.end :]).decode()


def _urdf_joint(extrinsic: ExportedExtrinsic, name: str) -> str:
    direction = "origin: pose of the child (optical: z forward) in the parent; rpy in rad, R = Rz(y) Ry(p) Rx(r)"
    xyz, rpy = (_number_row(of(extrinsic.T_parent_child)) for of in (_translation_m, roll_pitch_yaw))
    # Two hyphens in a row end a comment.
    remarks = "".join(f"    <!-- {comment.replace('--', '- -')} -->\n" for comment in extrinsic.remarks(direction))
    return (
        f'<joint name={quoteattr(name)} type="fixed">\n'
        f"{remarks}"
        f"    <parent link={quoteattr(extrinsic.parent)}/>\n"
        f"    <child link={quoteattr(extrinsic.child)}/>\n"
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "  </joint>"
    )


@dataclass(slots=True)
class _Joint:
    """A joint of a document: its name, its child link, and its place in bytes."""

    name: str
    begin: int
    child: str | None = None
    end: int = 0


@dataclass(slots=True)
class _JointScan:
    """The joints of a document, and where the root element ends."""

    joints: list[_Joint] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    root_end: int = 0


def _urdf_joints(data: bytes) -> _JointScan:
    parser = expat.ParserCreate(encoding="utf-8")
    scan = _JointScan()

    def start(tag: str, attributes: dict[str, str]) -> None:
        # A joint is below the root or in a xacro macro; a joint in a transmission has no child.
        if tag == "joint":
            scan.joints.append(_Joint(attributes.get("name", ""), parser.CurrentByteIndex))
        elif tag == "child" and scan.open[-1:] == ["joint"]:
            scan.joints[-1].child = attributes.get("link")
        scan.open.append(tag)

    def end(tag: str) -> None:
        scan.open.pop()
        if tag == "joint":
            scan.joints[-1].end = data.index(b">", parser.CurrentByteIndex) + 1
        if not scan.open:
            scan.root_end = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise OutputError(f"the file is no XML: {error}") from error
    return scan


# --- what several formats share -------------------------------------------------------------------------------------


def _camera(extrinsic: ExportedExtrinsic, name: str) -> CameraIntrinsics:
    if extrinsic.camera is None:
        raise OutputError(
            f"{name} needs the intrinsics of the camera, which are unknown here: export from a window, or give --config"
        )
    return extrinsic.camera


def _comments(extrinsic: ExportedExtrinsic, direction: str) -> list[str]:
    return [f"# {comment}" for comment in extrinsic.remarks(direction)]


def _lines(lines: Iterable[str]) -> str:
    return "\n".join(lines) + "\n"


def _number_row(values: Sequence[float]) -> str:
    """Numbers with blanks between them, exact to the bit."""
    return " ".join(map(repr, values))


def _translation_m(T: Matrix4) -> list[float]:
    return [float(value) for value in T[:3, 3]]


def _quaternion_xyzw(T: Matrix4) -> list[float]:
    """Unit quaternion, w ≥ 0."""
    from coec.geometry.se3 import quaternion_xyzw_from_rotation

    return [float(value) for value in quaternion_xyzw_from_rotation(T[:3, :3])]


def _quaternion_wxyz(T: Matrix4) -> list[float]:
    x, y, z, w = _quaternion_xyzw(T)
    return [w, x, y, z]


def roll_pitch_yaw(T: Matrix4) -> list[float]:
    """[roll, pitch, yaw] of a transform (4, 4) in radians, R = Rz(yaw)·Ry(pitch)·Rx(roll), as in URDF and ROS.

    Yaw is taken first, then pitch and roll from the rest of the rotation. This is exact even for a pitch of a right
    angle, where yaw and roll turn about the same axis and only their sum is determined.
    """
    R = T[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    cosine, sine = math.cos(yaw), math.sin(yaw)
    forward = cosine * R[0] + sine * R[1]
    left = cosine * R[1] - sine * R[0]
    return [math.atan2(-left[2], left[1]), math.atan2(-R[2, 0], forward[0]), yaw]


def _parsed_json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise OutputError(f"the file is no JSON: {error}") from error


def _json_text(document: object) -> str:
    return json.dumps(document, indent=2) + "\n"


def _with_yaml_entry(text: str | None, path: Sequence[str], lines: Sequence[str]) -> str:
    """A YAML document, whose root is a map in block style, with one entry set: replaced if it exists, else added at the
    end of the map that should hold it; a document of this entry alone if there is none yet.

    Args:
        path: keys from the root to the entry.
        lines: lines of the value below the key, without indentation.

    Raises:
        OutputError: not such a document, or the entry cannot be changed without touching others.
    """
    if text is None:
        return _lines(_entry_rows(path, lines, 0))
    before = _parsed_yaml(text)
    parent, depth = _deepest(before, path)
    rows = text.splitlines()
    if depth == len(path):
        begin, column = parent.lc.key(path[-1])
        if rows[begin][:column].strip():
            raise OutputError(f"`{path[-1]}` stands among others on line {begin + 1}: it cannot be changed alone")
        end = _end_of(rows, begin, column)
        rows[begin:end] = _entry_rows(path[-1:], lines, column)
    else:
        column, end = _room_in(parent, rows, path[:depth])
        rows[end:end] = _entry_rows(path[depth:], lines, column)
    after = _lines(rows)
    if _without(_parsed_yaml(after), path) != _without(before, path):
        raise OutputError(f"`{path[-1]}` cannot be set without changing something else of the file")
    return after


def _entry_rows(path: Sequence[str], lines: Sequence[str], column: int) -> list[str]:
    rows = [*("  " * level + f"{key}:" for level, key in enumerate(path)), *("  " * len(path) + line for line in lines)]
    return [" " * column + row for row in rows]


def _parsed_yaml(text: str) -> CommentedMap:
    from ruamel.yaml import YAML as RoundTrip  # noqa: N811
    from ruamel.yaml.comments import CommentedMap
    from ruamel.yaml.error import YAMLError

    try:
        document = RoundTrip().load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        raise OutputError(f"the file is no YAML that can be changed: {str(error).splitlines()[0]}") from error
    if not isinstance(document, CommentedMap):
        raise OutputError("the file holds no map of names")
    return document


def _deepest(document: CommentedMap, path: Sequence[str]) -> tuple[CommentedMap, int]:
    """The map that holds the longest existing part of the path, and how many keys that part has."""
    deepest = document
    for depth, key in enumerate(path):
        if key not in deepest:
            return deepest, depth
        if depth + 1 == len(path):
            break
        deepest = deepest[key]
        if not isinstance(deepest, dict):
            raise OutputError(f"`{key}` is no map of names")
    return deepest, len(path)


def _end_of(rows: Sequence[str], line: int, column: int) -> int:
    """The line behind the entry that begins at a line and column."""
    end = line + 1
    for number in range(line + 1, len(rows)):
        row = rows[number]
        inside = len(row) - len(row.lstrip())
        if row.strip() and inside <= column and not (inside == column and row.lstrip().startswith("- ")):
            break
        if row.strip():
            end = number + 1
    return end


def _room_in(parent: CommentedMap, rows: Sequence[str], path: Sequence[str]) -> tuple[int, int]:
    """Column of the keys of a map in block style, and the line behind its last entry."""
    if not len(parent):
        raise OutputError(f"`{'.'.join(path)}` is an empty map: write into another file")
    last = list(parent)[-1]
    line, column = parent.lc.key(last)
    if rows[line][:column].strip():
        raise OutputError(f"the entries beside `{last}` stand on one line: another cannot be put among them")
    return column, _end_of(rows, line, column)


def _without(document: Any, path: Sequence[str]) -> Any:
    """Plain values of a document without the entry, and without maps that hold only the entry."""
    if not isinstance(document, dict) or not path:
        return document
    rest = {key: value for key, value in document.items() if key != path[0]}
    if len(path) > 1 and path[0] in document:
        inner = _without(document[path[0]], path[1:])
        if inner:
            rest[path[0]] = inner
    return rest
