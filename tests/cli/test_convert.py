"""`coec convert OUT.mcap`: the bag is a source again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cli.conftest import SMALL, Coec
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.io.recordings.layouts import open_source
from support.readers import read_recording


def test_bag_reads_back_to_the_same_frames(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    outcome = coec("convert", SMALL, path)
    assert outcome.status == 0
    assert "depth maps" in outcome.err
    before, after = open_source(SMALL), open_source(str(path))
    assert after.camera_stamps_ns == before.camera_stamps_ns
    np.testing.assert_allclose(after.rig.T_camera_lidar_nominal, before.rig.T_camera_lidar_nominal, atol=1e-12)
    np.testing.assert_allclose(after.rig.T_lidar_ego, before.rig.T_lidar_ego, atol=1e-12)
    for ours, theirs in zip(before.messages(), after.messages(), strict=True):
        assert (type(ours), ours.stamp_ns, ours.frame_id) == (type(theirs), theirs.stamp_ns, theirs.frame_id)
        match ours, theirs:
            case CameraFrame(), CameraFrame():
                assert ours.image == theirs.image
            case LidarFrame(), LidarFrame():
                np.testing.assert_array_equal(ours.xyz_m, theirs.xyz_m)
            case EgoMotion(), EgoMotion():
                assert ours.linear_mps == theirs.linear_mps


def test_bag_opens_in_ros_tools(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    coec("convert", SMALL, path)
    bag = read_recording(path)
    assert (
        bag.types.keys()
        == bag.counts.keys()
        == {
            "/tf_static",
            "/sim/camera/camera_info",
            "/sim/camera/image/compressed",
            "/sim/lidar/points",
            "/sim/odometry",
        }
    )
    assert bag.latched == {"/tf_static"}


def test_a_recording_is_overwritten_only_on_request(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"an hour of driving")
    refused = coec("convert", SMALL, path)
    assert refused.status == 1
    assert "--force" in refused.err
    assert path.read_bytes() == b"an hour of driving"
    assert coec("convert", SMALL, path, "--full").status == 2
    assert coec("convert", SMALL, path, "--force").status == 0
    assert path.stat().st_size > 1000


def test_other_endings_are_refused(coec: Coec, tmp_path: Path) -> None:
    assert coec("convert", SMALL, tmp_path / "drive.bag").status == 2


def test_failure_leaves_nothing_behind(coec: Coec, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    outcome = coec("convert", SMALL, tmp_path / "file" / "drive.mcap")
    assert outcome.status == 1
    assert "cannot write" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
