"""KITTI's odometry benchmark: one sequence in its official folders."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from coec.calibration.types import CameraFrame, LidarFrame
from coec.errors import SourceError
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import HasRecognitions

CALIB = """P0: 700 0 31.5 0 0 700 23.5 0 0 0 1 0
P2: 700 0 31.5 35 0 700 23.5 -7 0 0 1 0.004
Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 -0.3
"""


def a_sequence(folder: Path, calib: str = CALIB, times: str = "0.0\n0.1\n0.2\n") -> Path:
    for name in ("image_2", "velodyne"):
        (folder / name).mkdir(parents=True)
    (folder / "calib.txt").write_text(calib)
    (folder / "times.txt").write_text(times)
    for index in range(3):
        cv2.imwrite(str(folder / "image_2" / f"{index:06d}.png"), np.full((48, 64, 3), index, np.uint8))
        np.full((5, 4), index + 1, "<f4").tofile(folder / "velodyne" / f"{index:06d}.bin")
    return folder


@pytest.mark.parametrize("prefix", ["", "kitti-odometry:"])
def test_a_sequence_is_read(tmp_path: Path, prefix: str) -> None:
    recording = open_source(f"{prefix}{a_sequence(tmp_path / '00')}")
    T = recording.rig.T_camera_lidar_nominal
    assert T[:3, :3].tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    # The camera's offset K⁻¹·p, with p's last number as depth, besides that of the LiDAR.
    x, y, z = (35 - 31.5 * 0.004) / 700, (-7 - 23.5 * 0.004) / 700, 0.004
    np.testing.assert_allclose(T[:3, 3], [0.1 + x, 0.2 + y, -0.3 + z], atol=1e-12)
    assert (recording.rig.camera.fx, recording.rig.camera.cx) == (700.0, 31.5)
    assert recording.camera_stamps_ns == (0, 10**8, 2 * 10**8)
    messages = list(recording.messages([1]))
    assert [type(m) for m in messages] == [LidarFrame, CameraFrame]
    assert isinstance(messages[0], LidarFrame)
    assert messages[0].xyz_m.tolist() == [[2, 2, 2]] * 5
    assert isinstance(recording, HasRecognitions)
    assert [one.code for one in recording.recognitions] == ["already_compensated"]


@pytest.mark.parametrize(
    ("calib", "times", "complaint"),
    [
        ("P2: 1 2\n", "0\n0.1\n0.2\n", "P2 must hold 12"),
        (CALIB.replace("P2: 700", "P2: 0"), "0\n0.1\n0.2\n", "no focal length"),
        (CALIB.split("Tr")[0], "0\n0.1\n0.2\n", "has no entry Tr"),
        (CALIB, "0\n0.1\n", "ends before frame 2"),
        (CALIB, "0\n0.1\nx\n", "no time in seconds"),
        (CALIB, "0\n0.1\ninf\n", "no time in seconds"),
        (CALIB, "0\n0.1\n0.1\n", "do not ascend"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, calib: str, times: str, complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        open_source(str(a_sequence(tmp_path / "00", calib, times)))


def test_other_layouts_name_this_one(tmp_path: Path) -> None:
    folder = a_sequence(tmp_path / "00")
    with pytest.raises(SourceError, match="write kitti-odometry:"):
        open_source(f"kitti-raw:{folder}")
    with pytest.raises(SourceError, match="has no camera image_3; there: image_2"):
        open_source(f"kitti-odometry:{folder}?camera=image_3")
    with pytest.raises(SourceError, match="is no sequence of KITTI's odometry benchmark"):
        open_source(f"kitti-odometry:{tmp_path}")
