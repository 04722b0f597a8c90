"""Intrinsics in the files of other programs, as those write them: the same lens as in a `CameraInfo`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from coec.errors import SourceError
from coec.io.intrinsics_files import load_camera_document, with_camera

K = [[320.0, 0.0, 319.5], [0.0, 321.0, 199.5], [0.0, 0.0, 1.0]]
PINHOLE = {"model": "pinhole", "width": 640, "height": 400, "fx": 320.0, "fy": 321.0, "cx": 319.5, "cy": 199.5}
FLAT = [number for row in K for number in row]


def kalibr(model: str, intrinsics: list[float], distortion: str = "none", d: tuple[float, ...] = ()) -> dict[str, Any]:
    return {
        "camera_model": model,
        "intrinsics": intrinsics,
        "distortion_model": distortion,
        "distortion_coeffs": list(d),
        "resolution": [640, 400],
    }


def basalt(kind: str, **more: float) -> dict[str, Any]:
    camera = {"camera_type": kind, "intrinsics": {"fx": 320.0, "fy": 321.0, "cx": 319.5, "cy": 199.5, **more}}
    return {"value0": {"T_imu_cam": [{}], "intrinsics": [camera], "resolution": [[640, 400]]}}


def apollo(d: list[float]) -> dict[str, Any]:
    parameters = {"img_dist_w": 640, "img_dist_h": 400, "cam_K": {"rows": 3, "data": K}, "cam_dist": {"data": [d]}}
    return {"center_camera-intrinsic": {"device_type": "camera", "param": parameters}}


FOCAL = [320.0, 321.0, 319.5, 199.5]
RADTAN = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
FISHEYE = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
RATIONAL = {"k1": 0.3, "k2": -0.02, "p1": 0.0, "p2": 0.0, "k3": 0.01, "k4": 0.5, "k5": -0.06, "k6": 0.03}


@pytest.mark.parametrize(
    ("document", "model", "parameters"),
    [
        ({"cam0": kalibr("pinhole", FOCAL)}, "pinhole", {}),
        (
            {"cam0": kalibr("pinhole", FOCAL, "radtan", tuple(RADTAN.values()))},
            "radtan",
            {**RADTAN, "k3": 0.0},
        ),
        ({"cam0": kalibr("pinhole", FOCAL, "equidistant", (0.1, 0.2, 0.3, 0.4))}, "kannala_brandt", FISHEYE),
        ({"cam0": kalibr("ds", [-0.2, 0.6, *FOCAL])}, "double_sphere", {"xi": -0.2, "alpha": 0.6}),
        ({"cam0": kalibr("eucm", [0.6, 1.1, *FOCAL])}, "eucm", {"alpha": 0.6, "beta": 1.1}),
        ({"cam0": kalibr("omni", [1.5, *FOCAL], "radtan", tuple(RADTAN.values()))}, "mei", {"xi": 1.5, **RADTAN}),
        (basalt("pinhole"), "pinhole", {}),
        (basalt("ds", xi=-0.2, alpha=0.6), "double_sphere", {"xi": -0.2, "alpha": 0.6}),
        (basalt("kb4", **FISHEYE), "kannala_brandt", FISHEYE),
        (basalt("eucm", alpha=0.6, beta=1.1), "eucm", {"alpha": 0.6, "beta": 1.1}),
        (basalt("pinhole-radtan8", **RATIONAL, rpmax=2.7), "rational", RATIONAL),
        (apollo(list(RADTAN.values())), "radtan", {**RADTAN, "k3": 0.0}),
        (apollo(list(RATIONAL.values())), "rational", RATIONAL),
        ({"CameraMat": {"data": FLAT}, "DistCoeff": {"data": [0.0] * 5}, "ImageSize": [640, 400]}, "pinhole", {}),
        ({"K": FLAT, "D": [0.0] * 14, "width": 640, "height": 400}, "pinhole", {}),
        (
            {"K": FLAT, "D": [*FISHEYE.values()], "fisheye_model": 1, "image_size": [640, 400]},
            "kannala_brandt",
            FISHEYE,
        ),
    ],
)
def test_each_program_means_its_lens(document: dict[str, Any], model: str, parameters: dict[str, float]) -> None:
    assert with_camera(document, Path("file")) == {"camera": {**PINHOLE, "model": model, **parameters}}
    nested = {"pair": "front", "camera": document}
    assert with_camera(nested, Path("file")) == {"pair": "front", "camera": {**PINHOLE, "model": model, **parameters}}


def test_what_opencv_writes_itself(tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 400)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([[*RADTAN.values(), 0.0]]))
    storage.release()
    document, name = load_camera_document(path)
    assert name == ""
    assert with_camera(document, path)["camera"] == {**PINHOLE, "model": "radtan", **RADTAN, "k3": 0.0}


@pytest.mark.parametrize("behind", ["---\n", "---\nheight: 3\n---\n", ""])
@pytest.mark.parametrize("before", ["", "%YAML:1.0\n---\n", "# printed\n---\n"])
def test_what_ros2_topic_echo_prints(tmp_path: Path, before: str, behind: str) -> None:
    path = tmp_path / "info.yaml"
    printed = f"header:\n  frame_id: camera\nheight: 400\nwidth: 640\ndistortion_model: plumb_bob\nd: []\nk: {FLAT}\n"
    path.write_text(f"{before}{printed}{behind}")
    content, name = load_camera_document(path)
    assert with_camera(content, path, name)["camera"] == PINHOLE


def test_a_size_that_the_file_does_not_hold_is_that_of_the_images() -> None:
    assert with_camera({"camera_matrix": {"data": FLAT}}, Path("file"), size=(640, 400)) == {"camera": PINHOLE}
    with pytest.raises(SourceError, match="image_width is missing"):
        with_camera({"camera_matrix": {"data": FLAT}}, Path("file"))


def test_one_of_several_cameras_is_named_behind_the_path(tmp_path: Path) -> None:
    T = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
    chain = {"cam0": kalibr("pinhole", FOCAL), "cam1": {**kalibr("ds", [-0.2, 0.6, *FOCAL]), "T_cam_lidar": T}}
    (tmp_path / "camchain.yaml").write_text(json.dumps(chain))
    document, name = load_camera_document(tmp_path / "camchain.yaml#cam1")
    assert name == "cam1"
    result = with_camera(document, tmp_path / "camchain.yaml", name)
    assert (result["camera"]["model"], result["T_camera_lidar"]) == ("double_sphere", T)
    named = with_camera({"camera": "camchain.yaml#cam0"}, tmp_path / "dataset.yaml")
    assert named["camera"] == PINHOLE
    with pytest.raises(SourceError, match=r"several cameras: name one, camchain.yaml#cam0, camchain.yaml#cam1"):
        with_camera(document, tmp_path / "camchain.yaml")


@pytest.mark.parametrize(
    ("document", "complaint"),
    [
        ({"cam0": kalibr("pinhole", FOCAL, "fov", (0.9,))}, "cam0: Kalibr's pinhole-fov is no camera model here"),
        ({"cam0": kalibr("ds", FOCAL)}, "intrinsics has 4 numbers, not 6"),
        ({"cam0": {**kalibr("pinhole", FOCAL), "resolution": [640]}}, "resolution is missing"),
        (basalt("ds", xi=0.1), "xi alpha is no list of numbers"),
        (basalt("bal"), "Basalt's bal is no camera model here"),
        ({"value0": {"intrinsics": [7]}}, "0: intrinsics are missing"),
        (apollo([0.1, 0.1, 0.0, 0.0, *[0.0] * 8, 0.02, 0.0]), r"a tilted sensor \(tau\)"),
        (apollo([0.1, 0.1, 0.0, 0.0, *[0.0] * 4, 0.02, 0.0, 0.0, 0.0]), r"thin prisms \(s1 to s4\)"),
        ({"K": FLAT, "D": [0.1, 0.2, 0.3, 0.4], "image_size": [640, 400]}, "add `distortion_model: plumb_bob`"),
        ({"K": FLAT[:8], "width": 640, "height": 400}, "camera_matrix has 8 numbers, not 9"),
        ({"K": ["a"] * 9, "width": 640, "height": 400}, "camera_matrix is no list of numbers"),
        ({"K": [10**400] * 9, "width": 640, "height": 400}, "camera_matrix is no list of numbers"),
        ({"K": 5, "width": 640, "height": 400}, "camera_matrix is missing"),
    ],
)
def test_what_describes_no_lens_is_refused_by_name(document: dict[str, Any], complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        with_camera(document, Path("file"))


def test_the_text_of_camera_calibration_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "ost.txt").write_text("# oST version 5.0 parameters\n\n[image]\n\nwidth\n640\n")
    with pytest.raises(SourceError, match=r"ost\.yaml beside it"):
        load_camera_document(tmp_path / "ost.txt")


def test_xml_of_opencv_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "camera.xml").write_text('<?xml version="1.0"?>\n<opencv_storage></opencv_storage>\n')
    with pytest.raises(SourceError, match=r"writes the same as YAML if the name ends with \.yml"):
        load_camera_document(tmp_path / "camera.xml")
