"""Every format read back by somebody else's reader, or by its definition written out once more: the same transform."""

from __future__ import annotations

import json
import math
import re
import shlex
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies
from numpy.typing import NDArray
from ruamel.yaml import YAML

from coec.config import CameraIntrinsics
from coec.errors import OutputError
from coec.io.exports import FORMATS, roll_pitch_yaw
from coec.io.ros.camera_info import info_of_yaml, intrinsics_of_info
from golden.scene import LENSES
from support.estimates import exported_extrinsic

Matrix = NDArray[np.float64]

TOLERANCE = 1e-12


def rotation_of(wxyz: list[float]) -> Matrix:
    w, x, y, z = wxyz
    # Hamilton's product q·v·q⁻¹ for the three unit vectors.
    columns = []
    for v in np.eye(3):
        u = np.array([x, y, z])
        columns.append(v + 2 * w * np.cross(u, v) + 2 * np.cross(u, np.cross(u, v)))
    return np.array(columns).T


def inverse(T: Matrix) -> Matrix:
    return np.asarray(np.linalg.inv(T), dtype=np.float64)


def turned(roll: float, pitch: float, yaw: float) -> Matrix:
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(Rz @ Ry @ Rx)


def pose(rotation: Matrix, translation: object) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, np.asarray(translation, dtype=float)
    return T


def read_tf(text: str) -> Matrix:
    start = "ros2 run tf2_ros static_transform_publisher"
    line = next(line for line in text.splitlines() if line.startswith(start) and line.endswith(" cam0 &"))
    labels = shlex.split(line.removesuffix(" &"))
    given = dict(zip(labels[4::2], labels[5::2], strict=True))
    assert (given["--frame-id"], given["--child-frame-id"]) == ("base_link", "cam0")
    q = [float(given[f"--q{name}"]) for name in "wxyz"]
    return inverse(pose(rotation_of(q), [float(given[f"--{name}"]) for name in "xyz"]))


def read_urdf(text: str) -> Matrix:
    joint = ElementTree.fromstring(text).find("joint[@type='fixed']")
    assert joint is not None
    parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
    assert parent is not None
    assert child is not None
    assert origin is not None
    assert (parent.get("link"), child.get("link")) == ("base_link", "cam0")
    numbers = {name: [float(item) for item in str(origin.get(name)).split()] for name in ("xyz", "rpy")}
    return inverse(pose(turned(*numbers["rpy"]), numbers["xyz"]))


def read_autoware(text: str) -> Matrix:
    given = YAML(typ="safe").load(text)["base_link"]["cam0"]
    T_parent_body = pose(turned(given["roll"], given["pitch"], given["yaw"]), [given["x"], given["y"], given["z"]])
    T_body_optical = pose(rotation_of([0.5, -0.5, 0.5, -0.5]), [0, 0, 0])  # x y z w: -.5 .5 -.5 .5
    return inverse(T_parent_body @ T_body_optical)


def read_kalibr(text: str) -> Matrix:
    return np.array(YAML(typ="safe").load(text)["cam0"]["T_cam_lidar"])


def read_kitti(text: str) -> Matrix:
    lines = dict(line.split(": ", 1) for line in text.splitlines())
    numbers = {name: np.array([float(item) for item in lines[name].split()]) for name in ("R", "T")}
    return pose(numbers["R"].reshape(3, 3), numbers["T"])


def read_kitti360(text: str) -> Matrix:
    line = np.loadtxt(text.splitlines())
    return inverse(np.vstack((line.reshape(3, 4), [0, 0, 0, 1])))


def read_nuscenes(text: str) -> Matrix:
    (record,) = json.loads(text)
    assert record["camera_intrinsic"][0] == [700.5, 0.0, 699.5]
    return inverse(pose(rotation_of(record["rotation"]), record["translation"]))


def read_openlabel(text: str) -> Matrix:
    systems = json.loads(text)["openlabel"]["coordinate_systems"]
    assert systems["base_link"]["children"] == ["cam0"]
    reported = systems["cam0"]["pose_wrt_parent"]
    x, y, z, w = reported["quaternion"]
    return inverse(pose(rotation_of([w, x, y, z]), reported["translation"]))


def read_colmap(text: str) -> Matrix:
    _, camera = json.loads(text)[-1]["cameras"]
    return pose(rotation_of(camera["cam_from_rig_rotation"]), camera["cam_from_rig_translation"])


def read_opencv(text: str) -> Matrix:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    return np.asarray(storage.getNode("T_cam0_base_link").mat())


def read_json(text: str) -> Matrix:
    return np.array(json.loads(text)["T_child_parent"])


def read_camera_info(text: str) -> Matrix:
    line = next(line for line in text.splitlines() if line.startswith("# cam0 in base_link: "))
    translation, quaternion = (json.loads(part) for part in re.findall(r"\[.*?\]", line))
    return inverse(pose(rotation_of([quaternion[3], *quaternion[:3]]), translation))


READERS: dict[str, Callable[[str], Matrix]] = {
    "tf": read_tf,
    "urdf": read_urdf,
    "autoware": read_autoware,
    "kalibr": read_kalibr,
    "kitti": read_kitti,
    "kitti360": read_kitti360,
    "nuscenes": read_nuscenes,
    "openlabel": read_openlabel,
    "colmap": read_colmap,
    "opencv": read_opencv,
    "json": read_json,
    "ros_camera_info": read_camera_info,
}

TURNS = strategies.lists(strategies.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)


def test_every_format_has_a_reader_here() -> None:
    assert READERS.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", FORMATS)
@given(xi=TURNS)
def test_what_is_read_is_what_was_written(name: str, xi: Matrix) -> None:
    reported = exported_extrinsic(xi)
    np.testing.assert_allclose(
        READERS[name](FORMATS[name].text(reported, None)), reported.T_child_parent, atol=TOLERANCE, rtol=0
    )


@pytest.mark.parametrize("name", FORMATS)
def test_every_file_says_direction_spread_and_origin(name: str) -> None:
    text = FORMATS[name].text(exported_extrinsic(np.zeros(6)), None)
    assert "front-12" in text
    assert "1e-07" in text  # the first variance
    assert any(word in text for word in ("pose", "maps", "p_camera"))
    assert "NOT ACCEPTED" not in text
    assert '"accepted": false' not in text


@pytest.mark.parametrize("name", FORMATS)
def test_every_file_says_with_which_intrinsics_it_holds(name: str) -> None:
    exported = exported_extrinsic(np.zeros(6))
    assert exported.intrinsics is not None
    assert exported.intrinsics.sha256 is not None
    text = FORMATS[name].text(exported, None)
    assert exported.intrinsics.sha256 in text
    assert "700.5" in text
    if name not in ("kalibr", "ros_camera_info"):
        assert "sha256" not in FORMATS[name].text(exported_extrinsic(np.zeros(6), camera=None), None)


@pytest.mark.parametrize("lens", LENSES)
def test_camera_info_is_read_back_to_the_same_lens(lens: str) -> None:
    camera = CameraIntrinsics(model=lens, width=240, height=160, **LENSES[lens])
    content = info_of_yaml(
        YAML(typ="safe").load(FORMATS["ros_camera_info"].text(exported_extrinsic(np.zeros(6), (), camera), None))
    )
    assert content is not None
    read = intrinsics_of_info(content, rectified=False).intrinsics
    if lens in ("pinhole", "radtan", "rational", "kannala_brandt"):
        assert read == camera
    else:
        assert read.model == "kannala_brandt"


def test_camera_info_without_intrinsics_says_where_they_come_from() -> None:
    with pytest.raises(OutputError, match=r"export from a window, or give --config"):
        FORMATS["ros_camera_info"].text(exported_extrinsic(np.zeros(6), camera=None), None)


@pytest.mark.parametrize("name", FORMATS)
def test_what_was_forced_says_so(name: str) -> None:
    text = FORMATS[name].text(exported_extrinsic(np.zeros(6), ("The edges are faint.\n-- evil: <x>",)), None)
    assert "NOT ACCEPTED" in text or '"accepted": false' in text
    assert "The edges are faint." in text
    np.testing.assert_allclose(READERS[name](text), exported_extrinsic(np.zeros(6)).T_child_parent, atol=TOLERANCE)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9])
@given(roll=strategies.floats(-3.1, 3.1), yaw=strategies.floats(-3.1, 3.1))
def test_angles_where_yaw_and_roll_are_one(pitch: float, roll: float, yaw: float) -> None:
    R = turned(roll, pitch, yaw)
    np.testing.assert_allclose(turned(*roll_pitch_yaw(pose(R, [0, 0, 0]))), R, atol=TOLERANCE)


OTHERS = {
    "tf": "#!/bin/sh\n# ours\nros2 run tf2_ros static_transform_publisher --x 1 --child-frame-id cam1 &\nwait\n",
    "urdf": '<?xml version="1.0"?>\n<!-- by hand -->\n<robot name="r">\n  <link name=\'base_link\'/>\n'
    '  <joint name="j" type="fixed"><parent link="base_link"/><child link="cam0"/></joint>\n'
    '  <joint name="k" type="fixed">\n    <parent link="base_link"/> <child link="lidar"/>\n  </joint>\n</robot>\n',
    "autoware": "# the kit\nbase_link:\n  lidar/lidar_base: # roof\n    x: 0.50\n    roll: 0e0\n  cam0:\n    x: 9\n"
    "  # the rear\n  cam1:\n    x: 1\nother: {a: 1}\n",
    "kalibr": "cam0:\n  rostopic: /a\n\n# the second\ncam1:\n  T_cn_cnm1:\n  - [1.0, 0]\n  rostopic: '/b'\n",
    "opencv": "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]\n"
    "T_cam0_base_link: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 7. ]\nname: x\n",
}


@pytest.mark.parametrize("name", OTHERS)
def test_of_a_file_with_others_the_entry_alone_is_changed(name: str) -> None:
    before, reported = OTHERS[name], exported_extrinsic(np.full(6, 0.1))
    after = FORMATS[name].text(reported, before)
    np.testing.assert_allclose(READERS[name](after), reported.T_child_parent, atol=TOLERANCE)
    ours = ("cam0", "x: 9", "rostopic: /a", "rows: 1", "cols: 1", "dt: d", "data: [ 7. ]", "rows: 4", "cols: 4")
    retained = [line for line in before.splitlines() if not any(word in line for word in ours)]
    lines = iter(after.splitlines())
    assert all(line in lines for line in retained), after  # all of them, in their order
    again = FORMATS[name].text(reported, after)
    assert again == after


@pytest.mark.parametrize(
    ("name", "before", "retained"),
    [
        ("nuscenes", '[{"token": "t", "sensor_token": "lidar", "translation": [1, 2, 3]}]', "lidar"),
        ("openlabel", '{"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": {"0": {}}}}', "frames"),
        ("colmap", '[{"cameras": [{"image_prefix": "a/", "ref_sensor": true}]}]', "ref_sensor"),
    ],
)
def test_of_a_document_in_json_the_rest_is_retained(name: str, before: str, retained: str) -> None:
    once = FORMATS[name].text(exported_extrinsic(np.zeros(6)), before)
    assert retained in once
    assert FORMATS[name].text(exported_extrinsic(np.zeros(6)), once) == once
    assert FORMATS[name].text(exported_extrinsic(np.full(6, 0.1)), once) != once


@pytest.mark.parametrize("name", ["autoware", "kalibr", "urdf", "nuscenes", "openlabel", "colmap", "opencv"])
@pytest.mark.parametrize("existing", ["", "{", "7", "[1, 2]", "<a><b></a>", "\x00\xff"])
def test_a_file_that_is_something_else_is_refused(name: str, existing: str) -> None:
    with pytest.raises(OutputError):
        FORMATS[name].text(exported_extrinsic(np.zeros(6)), existing)


def test_colmap_means_poses_from_the_reference_of_a_rig() -> None:
    ours = FORMATS["colmap"].text(exported_extrinsic(np.zeros(6)), None)
    rear = replace(exported_extrinsic(np.full(6, 0.2)), child="cam1")
    (rig,) = json.loads(FORMATS["colmap"].text(rear, ours))  # the same parent: the same rig
    assert [camera["image_prefix"] for camera in rig["cameras"]] == ["base_link/", "cam0/", "cam1/"]
    others = json.dumps([{"cameras": [{"image_prefix": "cam0/", "ref_sensor": True}]}])
    with pytest.raises(OutputError, match="in a rig whose reference is"):
        FORMATS["colmap"].text(exported_extrinsic(np.zeros(6)), others)


def test_a_parent_that_holds_no_entries_is_refused() -> None:
    with pytest.raises(OutputError, match="`base_link` is no map of names"):
        FORMATS["autoware"].text(exported_extrinsic(np.zeros(6)), "base_link: 3\n")


def test_entries_on_one_line_are_not_torn_separate() -> None:
    with pytest.raises(OutputError, match="cannot be changed alone"):
        FORMATS["autoware"].text(exported_extrinsic(np.zeros(6)), "base_link: {cam0: {x: 1}, cam1: {x: 2}}\n")


def test_kalibr_without_intrinsics_says_where_they_come_from() -> None:
    with pytest.raises(OutputError, match=r"export from a window, or give --config"):
        FORMATS["kalibr"].text(exported_extrinsic(np.zeros(6), camera=None), None)


def test_the_script_starts_every_publisher_and_stays(tmp_path: Path) -> None:
    stub = tmp_path / "ros2"
    stub.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/called\n')
    stub.chmod(0o755)
    script = tmp_path / "publish.sh"
    script.write_text(FORMATS["tf"].text(exported_extrinsic(np.zeros(6)), OTHERS["tf"]))
    path = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
    subprocess.run(["/bin/sh", script], check=True, env=path, timeout=30)
    children = sorted(line.split()[-1] for line in (tmp_path / "called").read_text().splitlines())
    assert children == ["cam0", "cam1"]
