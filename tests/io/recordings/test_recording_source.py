"""The door to all recordings, and the order in which they hand out their messages."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Rig
from coec.errors import SourceError, UsageError
from coec.geometry import cameras
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, parse_spec

T = TypeVar("T")
IMAGE = EncodedImage(ImageFormat.MONO8, 1, 1, b"\0")


def a_recording(loaded: list[str]) -> FramewiseRecording:
    def frame(index: int) -> RecordedFrame:
        stamp_ns = index * 2_000_000_000
        return RecordedFrame(
            stamp_ns,
            noting(f"camera {index}", CameraFrame(stamp_ns, "camera", IMAGE)),
            stamp_ns,
            noting(f"lidar {index}", LidarFrame(stamp_ns, "lidar", np.zeros((1, 3), np.float32))),
        )

    def noting(name: str, value: T) -> Callable[[], T]:
        def load() -> T:
            loaded.append(name)
            return value

        return load

    camera = cameras.build("pinhole", width=1, height=1, fx=1, fy=1, cx=0, cy=0)
    rig = Rig("p", camera, "camera", "lidar", np.eye(4), np.eye(4))
    motions = tuple(EgoMotion(i * 500_000_000, "base", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for i in range(9))
    return FramewiseRecording("r", rig, np.eye(4), tuple(frame(i) for i in range(3)), motions)


def test_messages_ascend_and_the_camera_comes_after_its_partners() -> None:
    loaded: list[str] = []
    kinds = [(message.stamp_ns // 10**6, type(message).__name__) for message in a_recording(loaded).messages()]
    assert [stamp for stamp, _ in kinds] == sorted(stamp for stamp, _ in kinds)
    assert kinds[:3] == [(0, "EgoMotion"), (0, "LidarFrame"), (0, "CameraFrame")]
    assert len(kinds) == 9 + 3 + 3


def test_selected_frames_bring_their_partners_and_nothing_else_is_loaded() -> None:
    loaded: list[str] = []
    messages = a_recording(loaded).messages([1])
    assert not loaded
    got = list(messages)
    assert loaded == ["lidar 1", "camera 1"]
    assert [m.stamp_ns // 10**6 for m in got if isinstance(m, EgoMotion)] == [1000, 1500, 2000, 2500, 3000]


def test_a_frame_that_is_not_there_is_refused() -> None:
    with pytest.raises(UsageError, match="no camera frame 3"):
        list(a_recording([]).messages([0, 3]))


@pytest.mark.parametrize(
    ("text", "layout", "path", "query"),
    [
        ("kitti360:/data?camera=image_00&drive=d", "kitti360", "/data", {"camera": "image_00", "drive": "d"}),
        ("kitti-raw:rel/dir", "kitti-raw", "rel/dir", {}),
        ("sim:?seed=3", "sim", ".", {"seed": "3"}),
        ("sim:seed=3", "sim", ".", {"seed": "3"}),
        ("sim:", "sim", ".", {}),
        ("a/b.mcap?camera=/front/image", None, "a/b.mcap", {"camera": "/front/image"}),
        ("./with:colon.yaml", None, "./with:colon.yaml", {}),
    ],
)
def test_the_grammar(text: str, layout: str | None, path: str, query: dict[str, str]) -> None:
    spec = parse_spec(text)
    assert (spec.layout, spec.path, spec.query) == (layout, Path(path), query)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("nuscenes:/data", "unknown source layout 'nuscenes'"),
        ("kitti360:", "no path"),
        ("", "no path"),
        ("a.mcap?camera", "malformed query"),
        ("a.mcap?camera=", "camera has no value"),
        ("a.mcap?camera=/a&camera=/b", "camera given twice"),
        ("kitti360:.?kamera=image_00", "unknown query key kamera"),
        ("kitti-raw:.?kamera=image_00", "known here: drive, camera"),
    ],
)
def test_what_does_not_fit_the_grammar_is_refused_with_the_accepted_forms(text: str, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint) as caught:
        open_source(text)
    if "twice" not in complaint and "no value" not in complaint:
        assert "kitti360:ROOT" in str(caught.value)


def test_a_manifest_takes_no_query(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="takes none"):
        open_source(f"{tmp_path}?camera=x")


def test_paths_that_lead_nowhere(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="does not exist"):
        open_source(str(tmp_path / "absent.mcap"))
    with pytest.raises(SourceError, match=r"has neither a dataset\.yaml"):
        open_source(str(tmp_path))
    (tmp_path / "file.txt").write_text("x")
    with pytest.raises(UsageError, match="neither a folder nor"):
        open_source(str(tmp_path / "file.txt"))
