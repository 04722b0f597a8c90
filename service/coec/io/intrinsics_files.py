"""Intrinsics in the files of other programs: a `CameraInfo` as ROS's camera_calibration writes it, matrices of OpenCV,
camera chains of Kalibr, calibrations of Basalt, and the JSON of Apollo's and SensorsCalibration's tools. Each becomes
the content of a `CameraInfo`, so that a lens means the same whoever wrote it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from coec.config import FilePath, load_yaml
from coec.errors import SourceError
from coec.io.ros.camera_info import CameraInfoContent, info_of_yaml, intrinsics_of_info

_PATH: TypeAdapter[Path] = TypeAdapter(FilePath)

_NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "camera_matrix": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMat", "k", "K"),
    "distortion_coefficients": (
        "distortion_coefficients",
        "distCoeffs",
        "dist_coeffs",
        "Distortion_Coefficients",
        "DistCoeff",
        "d",
        "D",
    ),
    "image_width": ("image_width", "image_Width", "imageWidth", "width"),
    "image_height": ("image_height", "image_Height", "imageHeight", "height"),
    "image_size": ("image_size", "imageSize", "ImageSize"),
}
"""Names of the entries of a file: those of ROS, of OpenCV's samples, and of Autoware's calibration toolkit."""

_KALIBR: Final[Mapping[tuple[str, str], tuple[str, int]]] = {
    ("pinhole", "none"): ("", 0),
    ("pinhole", "radtan"): ("plumb_bob", 0),
    ("pinhole", "equidistant"): ("equidistant", 0),
    ("pinhole", "equi"): ("equidistant", 0),
    ("omni", "radtan"): ("mei", 1),
    ("ds", "none"): ("double_sphere", 2),
    ("eucm", "none"): ("eucm", 2),
}
"""The name of ROS and coec for Kalibr's camera and distortion models (Kalibr's wiki, "Supported models"), and how many
numbers of the projection come before the focal lengths."""

_BASALT: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "pinhole": ("", ()),
    "pinhole-radtan8": ("rational_polynomial", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("equidistant", ("k1", "k2", "k3", "k4")),
    "ds": ("double_sphere", ("xi", "alpha")),
    "eucm": ("eucm", ("alpha", "beta")),
}
"""The same for Basalt's cameras (basalt-headers, `generic_camera.hpp`), and the order of their coefficients."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera in a file, and the rows of its `T_camera_lidar` if that stands beside it."""

    info: CameraInfoContent
    T_camera_lidar: Any = None


def load_camera_document(path: Path) -> tuple[Any, str]:
    """The document of a YAML or JSON file, and the name of the camera behind a `#` in its path; empty without one.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
        SourceError: it is XML, or ROS's ost.txt.
    """
    file, name = path, ""
    if not path.exists() and "#" in path.name:
        file, name = path.with_name(path.name.rpartition("#")[0]), path.name.rpartition("#")[2]
    if file.suffix in (".txt", ".ini"):
        raise SourceError(f"{file} is no YAML or JSON: ROS's camera_calibration writes the same as ost.yaml beside it")
    if file.suffix == ".xml":
        raise SourceError(f"{file} is XML: OpenCV's FileStorage writes the same as YAML if the name ends with .yml")
    return load_yaml(file, first=True), name


def cameras_of(document: Any, size: tuple[int, int] | None = None) -> dict[str, CameraFile]:
    """The cameras in a document of another program, by their names there; empty if it is none that is known. `size`
    (width, height) of the images, px, is for files that do not hold it.

    Raises:
        SourceError: it is one, and a number is absent, or a model is not known.
    """
    if not isinstance(document, dict):
        return {}
    chain = {name: entry for name, entry in document.items() if isinstance(entry, dict) and "camera_model" in entry}
    if chain:
        return {str(name): _named(name, _of_kalibr, entry) for name, entry in chain.items()}
    basalt = document.get("value0")
    if isinstance(basalt, dict) and isinstance(basalt.get("intrinsics"), list):
        sizes = basalt.get("resolution")
        return {
            str(number): _named(number, _of_basalt, entry, _item(sizes, number))
            for number, entry in enumerate(basalt["intrinsics"])
        }
    sensors = {name: entry["param"] for name, entry in document.items() if _is_sensor(entry)}
    if sensors:
        return {str(name): _named(name, _of_matrices, _of_sensor(entry), size) for name, entry in sensors.items()}
    known = _entries(document)
    return {"": CameraFile(_of_matrices(known, size).info)} if "camera_matrix" in known else {}


def with_camera(
    document: Any, path: Path, name: str = "", *, rectified: bool = False, size: tuple[int, int] | None = None
) -> Any:
    """The document of a file with a `camera:`, in which that may be a camera of another program: its content, or its
    path. The whole file may be one, too; then `name` chooses one of several. Any other document is returned as it is.

    Raises:
        SourceError: it is a file of another program that describes no lens, or several.
        ConfigError: the named file cannot be read.
        ValidationError: its name is no path.
    """
    whole = cameras_of(document, size)
    camera = document.get("camera") if isinstance(document, dict) and not whole else document
    if isinstance(camera, str):
        path = path.parent / _PATH.validate_python(camera)
        if not path.is_file() and "#" not in path.name:
            raise SourceError(f"camera: there is no file {path}; give the lens here, or name a camera_info.yaml")
        camera, name = load_camera_document(path)
    try:
        candidates = whole or cameras_of(camera, size)
        if not candidates:
            return document
        if name not in candidates and (name or len(candidates) > 1):
            listed = ", ".join(f"{path.name}#{known}" for known in candidates)
            raise SourceError(f"it has several cameras: name one, {listed}")
        selected = candidates[name] if name in candidates else next(iter(candidates.values()))
        lens = intrinsics_of_info(selected.info, rectified=rectified).intrinsics.model_dump(exclude_none=True)
    except SourceError as error:
        raise SourceError(f"{path}, intrinsics of a camera: {error}") from error
    extrinsic = {} if selected.T_camera_lidar is None else {"T_camera_lidar": selected.T_camera_lidar}
    return {**extrinsic, "camera": lens} if whole else {**document, "camera": lens}


def _item(value: Any, number: int) -> Any:
    return value[number] if isinstance(value, list) and number < len(value) else None


def _is_sensor(entry: Any) -> bool:
    return isinstance(entry, dict) and isinstance(entry.get("param"), dict) and "cam_K" in entry["param"]


def _named(name: Any, read: Any, *arguments: Any) -> CameraFile:
    try:
        camera: CameraFile = read(*arguments)
    except SourceError as error:
        raise SourceError(f"{name}: {error}") from error
    return camera


def _entries(document: Mapping[Any, Any]) -> dict[str, Any]:
    """The entries of a CameraInfo, by ROS's names; the other entries of the document by their own."""
    known = {of_ros: document[one] for of_ros, names in _NAMES.items() for one in reversed(names) if one in document}
    others = {name: value for name, value in document.items() if not any(name in names for names in _NAMES.values())}
    return {**others, **known}


def _of_sensor(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "camera_matrix": parameters["cam_K"],
        "distortion_coefficients": parameters.get("cam_dist", ()),
        "distortion_model": "plumb_bob",
        **{
            of_ros: parameters[name]
            for of_ros, name in (("image_width", "img_dist_w"), ("image_height", "img_dist_h"))
            if name in parameters
        },
    }


def _of_matrices(entries: Mapping[str, Any], size: tuple[int, int] | None) -> CameraFile:
    """A camera of which matrices are given by ROS's names."""
    given = dict(entries)
    d = _numbers(given.get("distortion_coefficients", ()), "distortion_coefficients")
    if "fisheye_model" in given and "distortion_model" not in given:
        given["distortion_model"] = "equidistant" if given["fisheye_model"] else "plumb_bob"
    if "distortion_model" not in given and len(d) == 4 and any(d):
        raise SourceError(
            "four coefficients without a name may be k1 k2 p1 p2 of a polynomial or k1 k2 k3 k4 of a fisheye: add "
            "`distortion_model: plumb_bob` or `distortion_model: equidistant`"
        )
    both = _numbers(given.pop("image_size", ()), "image_size")
    for place, name in enumerate(("image_width", "image_height")):
        if name not in given and (len(both) == 2 or size is not None):
            given[name] = int(both[place]) if len(both) == 2 else size[place]  # type: ignore[index]
    given["camera_matrix"] = _numbers(given["camera_matrix"], "camera_matrix")
    info = info_of_yaml({**given, "distortion_coefficients": d})
    if info is None:
        raise SourceError("camera_matrix is missing")
    return CameraFile(info)


def _of_kalibr(entry: Mapping[str, Any]) -> CameraFile:
    model, distortion = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    if (model, distortion) not in _KALIBR:
        raise SourceError(f"Kalibr's {model}-{distortion} is no camera model here; known are {_listed(_KALIBR)}")
    name, before = _KALIBR[model, distortion]
    projection = _numbers(entry.get("intrinsics"), "intrinsics")
    if len(projection) != before + 4:
        raise SourceError(f"intrinsics has {len(projection)} numbers, not {before + 4}")
    d = (*projection[:before], *_numbers(entry.get("distortion_coeffs", ()), "distortion_coeffs"))
    return CameraFile(
        _info(projection[before:], name, d if name else (), entry.get("resolution")), entry.get("T_cam_lidar")
    )


def _of_basalt(entry: Any, resolution: Any) -> CameraFile:
    values = entry.get("intrinsics") if isinstance(entry, dict) else None
    if not isinstance(values, dict):
        raise SourceError("intrinsics are missing")
    kind = str(entry.get("camera_type"))
    if kind not in _BASALT:
        raise SourceError(f"Basalt's {kind} is no camera model here; known are {', '.join(_BASALT)}")
    name, order = _BASALT[kind]
    projection, d = (
        _numbers([values.get(one) for one in names], " ".join(names)) for names in (("fx", "fy", "cx", "cy"), order)
    )
    return CameraFile(_info(projection, name, d, resolution))


def _info(projection: Sequence[float], model: str, d: tuple[float, ...], resolution: Any) -> CameraInfoContent:
    fx, fy, cx, cy = projection
    size = _numbers(resolution, "resolution")
    if len(size) != 2 or not all(0 < side < 2**31 for side in size):
        raise SourceError("resolution is missing, or is not width and height")
    k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    p = (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    eye = tuple(np.eye(3).ravel().tolist())
    return CameraInfoContent("", (int(size[0]), int(size[1])), model, d, k, eye, p, (1, 1), (0, 0, 0, 0))


def _numbers(value: Any, name: str) -> tuple[float, ...]:
    """The numbers of a list, of a list of rows, or of a matrix with `data`."""
    value = value.get("data") if isinstance(value, dict) else value
    if not isinstance(value, list | tuple):
        raise SourceError(f"{name} is missing, or is no list of numbers")
    flat = [number for row in value for number in (row if isinstance(row, list) else [row])]
    try:
        return tuple(float(number) for number in flat)
    except (TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{name} is no list of numbers") from error


def _listed(known: Mapping[tuple[str, str], object]) -> str:
    return ", ".join("-".join(pair) for pair in known)
