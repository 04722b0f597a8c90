"""`coec sim`: a drive as a file, and as a source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from cli.conftest import Coec
from coec.calibration.types import CameraFrame, LidarFrame
from coec.errors import OutputError
from coec.io import user_files
from coec.io.recordings.layouts import open_lidars, open_source

pytestmark = pytest.mark.usefixtures("streets")

pytest.importorskip("embreex", reason="needs embreex")

SHORT = ("--seed", 4, "--seconds", 0.6, "--camera", "fisheye96", "--lidar", 16, "--camera-hz", 5, "--lidar-hz", 5)


@pytest.fixture(autouse=True)
def rendered_once() -> None:
    """Here the drawing itself is under test."""


def test_a_drive_reads_back_with_its_truth_next_to_it(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    outcome = coec(
        "sim", "drive", "--output", path, *SHORT, "--fault", "step:0.3:rx=3", "--workshop", "0,2,0", "--json"
    )
    assert outcome.status == 0
    assert outcome.document["frames"] == 3
    back = open_source(str(path))
    drive = open_source(
        "sim:seed=4&seconds=0.6&camera=fisheye96&lidar=16&camera_hz=5&lidar_hz=5&faults=step:0.3:rx=3&workshop=0,2,0"
    )
    np.testing.assert_allclose(back.rig.T_camera_lidar_nominal, drive.rig.T_camera_lidar_nominal, atol=1e-12)
    assert back.camera_stamps_ns == drive.camera_stamps_ns
    for ours, theirs in zip(drive.messages(), back.messages(), strict=True):
        assert (type(ours), ours.stamp_ns) == (type(theirs), theirs.stamp_ns)
        if isinstance(ours, CameraFrame) and isinstance(theirs, CameraFrame):
            assert ours.image == theirs.image
        if isinstance(ours, LidarFrame) and isinstance(theirs, LidarFrame):
            np.testing.assert_array_equal(ours.xyz_m, theirs.xyz_m)
    with AnyReader([path]) as reader:
        selected = [connection for connection in reader.connections if connection.topic == "/ground_truth/tf"]
        messages: list[Any] = [reader.deserialize(data, of.msgtype) for of, _, data in reader.messages(selected)]
    truth = [message.transforms[0].transform.translation for message in messages]
    camera_lidar = [np.array([t.x, t.y, t.z]) for t in truth[::2]]
    assert len(camera_lidar) == 3
    np.testing.assert_array_equal(camera_lidar[0], camera_lidar[1])
    assert np.abs(camera_lidar[2] - camera_lidar[0]).max() > 0.005  # turned about the camera by 3°


def test_a_picture(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "view.jpg"
    assert coec("sim", "view", "--output", path, "--camera", "fisheye96", "--at-s", 2).status == 0
    assert path.read_bytes()[:2] == b"\xff\xd8"


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("drive", "--output", "drive.bag"), ".mcap"),
        (("drive", "--output", "drive.mcap", "--fault", "rust:3"), "unknown fault"),
        (("drive", "--output", "drive.mcap", "--camera", "box"), "fisheye700"),
        (("view", "--output", "view.png"), ".jpg"),
    ],
)
def test_what_does_not_fit_is_refused(coec: Coec, arguments: tuple[str, ...], reported: str) -> None:
    outcome = coec("sim", *arguments)
    assert outcome.status == 2
    assert reported in outcome.err


def test_failure_leaves_nothing_behind(coec: Coec, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    assert coec("sim", "drive", "--output", tmp_path / "file" / "drive.mcap", *SHORT).status == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_drive_is_overwritten_only_on_request(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"an hour of driving")
    refused = coec("sim", "drive", "--output", path, *SHORT)
    assert refused.status == 1
    assert "--force" in refused.err
    assert path.read_bytes() == b"an hour of driving"


@pytest.mark.fault("a drive of a rig cannot be written", "nothing is left that refuses the next try")
def test_a_failed_drive_of_a_rig_does_not_refuse_the_next(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "rig"
    text = ("sim", "drive", "--output", folder, *RIG, "--seconds", 0.25)

    def full_disk(path: Path, data: bytes) -> Path:
        if path.name == "rear.yaml":
            raise OutputError(f"cannot write {path}: No space left on device")
        return user_files.write_output(path, data)

    with monkeypatch.context() as patch:
        patch.setattr("coec_lab.commands.drive_bags.write_output", full_disk)
        assert coec(*text).status == 1
    assert list(folder.iterdir()) == []
    assert coec(*text).status == 0
    again = coec(*text)
    assert again.status == 1
    assert f"{folder / 'drive.mcap'}" in again.err


RIG = ("--rig", "four-fisheyes", "--camera", "fisheye64", "--camera-hz", 4, "--lidar-hz", 4, "--scene", "room")


def test_a_rig_is_one_bag_whose_pairs_read_back_with_their_masks(coec: Coec, tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    outcome = coec(
        "sim",
        "drive",
        "--output",
        folder,
        *RIG,
        "--seed",
        4,
        "--seconds",
        0.25,
        "--fault",
        "roof:step:0:rz=2",
        "--json",
    )
    assert outcome.status == 0
    assert outcome.document["frames"] == 7
    assert len(outcome.document["sources"]) == 12
    text = "rig=four-fisheyes&seed=4&seconds=0.25&camera=fisheye64&camera_hz=4&lidar_hz=4&scene=room"
    text += "&faults=roof:step:0:rz=2"
    for name in ("rear-roof", "right-near_right"):
        back, drive = open_source(outcome.document["sources"][name]), open_source(f"sim:{text}&pair={name}")
        np.testing.assert_allclose(back.rig.T_camera_lidar_nominal, drive.rig.T_camera_lidar_nominal, atol=1e-9)
        np.testing.assert_allclose(back.rig.T_lidar_ego, drive.rig.T_lidar_ego, atol=1e-9)
        assert back.rig.mask is not None
        assert drive.rig.mask is not None
        np.testing.assert_array_equal(back.rig.mask, drive.rig.mask)
        assert back.rig.camera == drive.rig.camera
        for ours, theirs in zip(drive.messages(), back.messages(), strict=True):
            assert (type(ours), ours.stamp_ns, ours.frame_id) == (type(theirs), theirs.stamp_ns, theirs.frame_id)
            if isinstance(ours, CameraFrame) and isinstance(theirs, CameraFrame):
                assert ours.image == theirs.image
            if isinstance(ours, LidarFrame) and isinstance(theirs, LidarFrame):
                np.testing.assert_array_equal(ours.xyz_m, theirs.xyz_m)
    lidars = open_lidars(outcome.document["written"], "/roof/points", "/near_left/points")
    whole = open_lidars(f"sim:{text}", "roof", "near_left")
    np.testing.assert_allclose(lidars.rig.T_a_b_nominal, whole.rig.T_a_b_nominal, atol=1e-9)
    np.testing.assert_allclose(lidars.rig.T_a_ego, whole.rig.T_a_ego, atol=1e-9)
    (read,), (rendered,) = lidars.pairs(12), whole.pairs(12)
    for mine, yours in ((read.a, rendered.a), (read.b, rendered.b)):
        np.testing.assert_array_equal(mine.xyz_m, yours.xyz_m)
    assert read.motion is not None
    assert rendered.motion is not None
    assert read.motion == replace(rendered.motion, sequence=None)


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("--output", "rig.mcap", *RIG), "name a folder"),
        (("--output", "rig", *RIG, "--lidar", "16"), "--lidar of a rig"),
        (("--output", "rig", "--rig", "five"), "choose one of four-fisheyes"),
        (("--output", "rig", "--rig", "four-fisheyes", "--stop", 5), "makes no stops"),
        (("--output", "rig", *RIG, "--fault", "step:1:rx=1"), "of which sensor"),
    ],
)
def test_what_a_rig_does_not_take_is_refused(coec: Coec, arguments: tuple[str, ...], reported: str) -> None:
    outcome = coec("sim", "drive", *arguments)
    assert outcome.status == 2
    assert reported in outcome.err
