"""Recordings as input: one function, `open_source`, opens every layout."""

from __future__ import annotations

import shlex
from pathlib import Path

from coec.errors import SourceError, UsageError
from coec.io.recordings.recording_source import FORMS, RecordingSource, SourceSpec, installed_layout, is_bag, parse_spec

__all__ = ["RecordingSource", "open_source"]


def open_source(spec: str) -> RecordingSource:
    """Opens the recording that a SOURCE argument names (CONTRACT, "Command line"). Frames are loaded later.

    Raises:
        UsageError: the argument does not fit the grammar, or its query has an unknown key.
        SourceError: the recording is absent, incomplete or not in the layout that its name promises.
        WindowError: a recorded window is damaged.
    """
    parsed = parse_spec(spec)
    # Each layout is imported when it is asked for, because not all need OpenCV, rosbags and the MCAP readers.
    match parsed.layout:
        case "kitti360":
            from coec.io.recordings.kitti360 import open_kitti360

            return open_kitti360(parsed)
        case "kitti-raw":
            from coec.io.recordings.kitti import open_kitti_raw

            return open_kitti_raw(parsed)
        case "sim":
            source: RecordingSource = installed_layout("sim").open_recording(parsed.query)
            return source
    return _open_path(parsed)


ROS_1 = ".bag"


def _bags_of_ros_1(path: Path) -> list[Path]:
    """The file, or the files in a folder that holds nothing which is read."""
    if path.is_dir():
        readable = (path / "metadata.yaml").exists() or (path / "dataset.yaml").exists()
        return [] if readable else sorted(file for file in path.glob(f"*{ROS_1}") if file.is_file())
    return [path] if path.suffix == ROS_1 else []


def _open_path(spec: SourceSpec) -> RecordingSource:
    if not spec.path.exists():
        raise SourceError(f"{spec.path} does not exist", FORMS)
    ros_1 = _bags_of_ros_1(spec.path)
    if ros_1:
        given = " ".join(shlex.quote(str(path)) for path in ros_1)
        folder = spec.path.with_suffix("") if spec.path.suffix == ROS_1 else spec.path / "ros2"
        made = shlex.quote(str(folder))
        raise SourceError(
            f"{spec.path} is a bag of ROS 1, and bags of ROS 2 are read: `rosbags-convert --src {given} --dst {made}` "
            f"(installed with coec) writes one; then give {made}"
        )
    if is_bag(spec):
        from coec.io.recordings.bag import open_bag

        return open_bag(spec)
    if spec.path.is_dir() or spec.path.suffix in (".yaml", ".yml"):
        from coec.io.recordings.manifest import open_manifest

        return open_manifest(spec)
    raise UsageError(f"{spec.path} is neither a folder nor an .mcap, .db3, .yaml or .yml file", FORMS)
