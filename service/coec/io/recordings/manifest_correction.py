"""Writes a `dataset.yaml` without a mistake that was found in it, next to the original. Only the entries that change
are written anew, so that the others stay as they are, with their comments.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node

from coec.calibration.search.mistakes import INVERSE_POSE
from coec.calibration.types import Matrix4, Mistake
from coec.config import load_yaml
from coec.errors import ConfigError, OutputError, SourceError, UsageError
from coec.geometry import cameras, se3
from coec.geometry.cameras import Camera
from coec.io.recordings.manifest import FILE_NAME
from coec.io.recordings.recording_source import is_bag, parse_spec
from coec.io.user_files import read_bytes, write_output

DIGITS = 9
"""Decimal places of a matrix, as `coec calibrate` prints one."""

OTHER_DIRECTION = {"T_camera_lidar": "T_lidar_camera", "T_lidar_camera": "T_camera_lidar"}


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
    path = parse_spec(source).path
    return path / FILE_NAME if path.is_dir() else path


def has_manifest(source: str) -> bool:
    """Whether a SOURCE argument names a manifest, or a folder with one."""
    spec = parse_spec(source)
    is_manifest = spec.path.suffix in (".yaml", ".yml") or (spec.path / FILE_NAME).is_file()
    return spec.layout is None and not is_bag(spec) and is_manifest


def write_corrected(path: Path, mistake: Mistake, camera: Camera, T_camera_lidar: Matrix4) -> Correction:
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
        load_yaml(corrected)
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


def _pose_edit(key: Node, value: Node, mistake: Mistake) -> tuple[list[tuple[int, int, str]], str]:
    name = key.value
    if mistake.code == INVERSE_POSE and name in OTHER_DIRECTION:
        other = OTHER_DIRECTION[name]
        return [(key.start_mark.index, key.end_mark.index, other)], f"{name} is called {other}, with the same numbers"
    rows = [", ".join(f"{number + 0.0:.{DIGITS}f}" for number in row) for row in _orthonormal(mistake.T_camera_lidar)]
    lines = "".join(f"\n  - [{row}]" for row in rows)
    return [(key.start_mark.index, _end(value), f"T_camera_lidar:{lines}")], f"{name} is replaced by another pose"


def _orthonormal(T: Matrix4) -> Matrix4:
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
