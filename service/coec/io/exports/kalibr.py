"""Kalibr's camera chain: intrinsics with `T_cam_lidar` beside them. Models: Kalibr's wiki, "Supported models"."""

import re

from coec.config import CameraIntrinsics
from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic, set_yaml_entry

ENCODING = "application/yaml"
DIRECTION = "T_cam_lidar maps coordinates in the parent to the optical camera frame (z forward); rows of a 4x4 matrix"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The chain with this camera. Its entry has the name of the child frame if that has Kalibr's form (`cam0`), else
    `cam0`.

    Raises:
        OutputError: the intrinsics are not known, Kalibr has no such model, or the existing file cannot be changed.
    """
    if extrinsic.camera is None:
        raise OutputError(
            "kalibr needs the intrinsics of the camera, which are unknown here: export from a window, or give --config"
        )
    name = extrinsic.child if re.fullmatch(r"cam\d+", extrinsic.child) else "cam0"
    model, intrinsics, distortion_model, distortion = _camera(extrinsic.camera)
    lines = [
        *(f"# {comment}" for comment in extrinsic.remarks(DIRECTION)),
        f"camera_model: {model}",
        f"intrinsics: {_flow(intrinsics)}",
        f"distortion_model: {distortion_model}",
        f"distortion_coeffs: {_flow(distortion)}",
        f"resolution: [{extrinsic.camera.width}, {extrinsic.camera.height}]",
        "T_cam_lidar:",
        *(f"- {_flow(row)}" for row in extrinsic.T_child_parent.tolist()),
    ]
    if existing is None:
        return "\n".join((f"{name}:", *(f"  {line}" for line in lines))) + "\n"
    return set_yaml_entry(existing, (name,), lines)


def _camera(camera: CameraIntrinsics) -> tuple[str, list[float], str, list[float]]:
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


def _flow(values: list[float]) -> str:
    return f"[{', '.join(repr(value) for value in values)}]"
