"""In the readers' own environment: what other people's programs make of the files of `coec export`.

A request and an answer a line, in JSON: {"format": "urdf", "text": "..."} -> {"T_child_parent": [[...], ...]}. The
child is `cam0`, the parent `base_link`.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import yaml
import yourdfpy
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation
from vcd import core, scl

# x y z w of the optical frame in the body frame: REP 103.
OPTICAL_IN_BODY = (-0.5, 0.5, -0.5, 0.5)


def rigid(rotation: np.ndarray, translation: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def urdf(file: Path) -> np.ndarray:
    return yourdfpy.URDF.load(str(file), load_meshes=False).get_transform("base_link", "cam0")


def openlabel(file: Path) -> np.ndarray:
    """Validated against the published schema, then by the path that the library finds between the two frames."""
    document = core.OpenLABEL()
    document.load_from_file(str(file), validation=True)
    return scl.Scene(document).get_transform("base_link", "cam0")[0]


def colmap(file: Path) -> np.ndarray:
    (rig,) = pycolmap.read_rig_config(str(file))
    (camera,) = (camera for camera in rig.cameras if camera.image_prefix == "cam0/")
    return np.vstack((camera.cam_from_rig.matrix(), [0, 0, 0, 1]))


def nuscenes(file: Path) -> np.ndarray:
    """As the devkit's `transform_matrix(translation, Quaternion(rotation), inverse=True)`."""
    (record,) = json.loads(file.read_text())
    return np.linalg.inv(rigid(Quaternion(record["rotation"]).rotation_matrix, record["translation"]))


def opencv(file: Path) -> np.ndarray:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)  # its nodes are gone when it is
    return storage.getNode("T_cam0_base_link").mat()


def kalibr(file: Path) -> np.ndarray:
    """As Kalibr's CameraChainParameters: PyYAML, and a 4x4 array."""
    return np.array(yaml.safe_load(file.read_text())["cam0"]["T_cam_lidar"])


def autoware(file: Path) -> np.ndarray:
    """As Autoware's launch files hand it to static_transform_publisher: fixed axes, roll first."""
    given = yaml.safe_load(file.read_text())["base_link"]["cam0"]
    turned = Rotation.from_euler("xyz", [given["roll"], given["pitch"], given["yaw"]])
    body = rigid(turned.as_matrix(), [given["x"], given["y"], given["z"]])
    return np.linalg.inv(body @ rigid(Rotation.from_quat(OPTICAL_IN_BODY).as_matrix(), [0.0, 0.0, 0.0]))


def kitti(file: Path) -> np.ndarray:
    """As pykitti's `read_calib_file`: what is no row of numbers is passed over."""
    rows = {}
    for line in file.read_text().splitlines():
        key, value = line.split(":", 1)
        try:
            rows[key] = np.array([float(item) for item in value.split()])
        except ValueError:
            continue
    return rigid(rows["R"].reshape(3, 3), rows["T"])


def kitti360(file: Path) -> np.ndarray:
    return np.linalg.inv(np.vstack((np.loadtxt(file).reshape(3, 4), [0, 0, 0, 1])))


READERS: dict[str, Callable[[Path], np.ndarray]] = {
    "urdf": urdf,
    "openlabel": openlabel,
    "colmap": colmap,
    "nuscenes": nuscenes,
    "opencv": opencv,
    "kalibr": kalibr,
    "autoware": autoware,
    "kitti": kitti,
    "kitti360": kitti360,
}

with tempfile.TemporaryDirectory() as folder:
    for line in sys.stdin:
        request = json.loads(line)
        file = Path(folder) / f"export.{'yaml' if request['format'] == 'opencv' else request['format']}"
        file.write_text(request["text"])
        try:
            reported: dict[str, object] = {"T_child_parent": READERS[request["format"]](file).tolist()}
        except Exception as error:
            reported = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(reported), flush=True)
