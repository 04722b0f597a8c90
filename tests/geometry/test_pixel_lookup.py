"""The pixel of a point must be that of double precision, whatever single precision does on the way there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import se3
from coec.geometry.cameras import Camera, build, in_image
from coec.geometry.projection import NOT_IN_IMAGE, UNSURE, certain_pixels, exact_pixel, filter_of, project, unproject

SENSOR = {"width": 640, "height": 480, "fx": 200.0, "fy": 190.0, "cx": 321.3, "cy": 239.6}
CAMERAS = {
    "pinhole": build("pinhole", **SENSOR),
    "radtan": build("radtan", **SENSOR, k1=-0.3, k2=0.1, p1=1e-3, p2=-1e-3, k3=0.0),
    "kannala_brandt": build("kannala_brandt", **SENSOR, k1=-0.02, k2=0.01, k3=-0.003, k4=0.0),
    "mei": build("mei", **(SENSOR | {"fx": 570.0, "fy": 570.0}), xi=2.2, k1=0.017, k2=1.6, p1=4e-4, p2=4e-4),
    "eucm": build("eucm", **SENSOR, alpha=0.6, beta=1.1),
    "double_sphere": build("double_sphere", **SENSOR, xi=-0.2, alpha=0.6),
}
MODELS = [pytest.param(model, marks=pytest.mark.slow) if model == "radtan" else model for model in CAMERAS]
"""A kernel is compiled for each, before the tests but for this one, of which no other test has need."""
POSE = se3.perturbation(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))


def single_precision(camera: Camera, pose: NDArray[np.float64], xyz: NDArray[np.float32]) -> NDArray[np.int32]:
    view, pixel = filter_of(camera), np.empty(xyz.shape[1], np.int32)
    x, y, z = np.ascontiguousarray(xyz)
    largest = certain_pixels(view.camera, view.at(pose), pose.astype(np.float32), x, y, z, pixel)
    assert largest == pixel.max()
    return pixel


def double_precision(camera: Camera, pose: NDArray[np.float64], xyz: NDArray[np.float32]) -> NDArray[np.int64]:
    """By the projection of arrays, not by the check-up's own exact form."""
    with np.errstate(invalid="ignore"):
        p_camera = xyz.T.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    uv_px, valid = project(camera, p_camera)
    column, row = np.floor(uv_px.T + 0.5).astype(np.int64)
    return np.where(valid & in_image(camera, uv_px), row * camera.width + column, NOT_IN_IMAGE)


def cloud(seed: int, points: int, scale_m: float) -> NDArray[np.float32]:
    return np.random.default_rng(seed).normal(scale=scale_m, size=(3, points)).astype(np.float32)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scale_m", [0.3, 3.0, 30.0, 3e4])
def test_what_single_precision_is_sure_of_is_right(model: str, scale_m: float) -> None:
    camera = CAMERAS[model]
    xyz = cloud(1, 60_000, scale_m)
    result, expected = single_precision(camera, POSE, xyz), double_precision(camera, POSE, xyz)
    sure = result != UNSURE
    np.testing.assert_array_equal(result[sure], expected[sure])
    assert (result[sure] >= 0).sum() > 1000


@pytest.mark.parametrize("model", MODELS)
def test_it_is_sure_of_nearly_everything(model: str) -> None:
    assert (single_precision(CAMERAS[model], POSE, cloud(2, 100_000, 30.0)) == UNSURE).mean() < 0.004


@pytest.mark.parametrize("model", MODELS)
def test_double_precision_settles_the_rest(model: str) -> None:
    camera, xyz = CAMERAS[model], cloud(3, 2000, 5.0)
    result = [exact_pixel(camera, POSE, float(x), float(y), float(z)) for x, y, z in xyz.T]
    np.testing.assert_array_equal(result, double_precision(camera, POSE, xyz))


@pytest.mark.parametrize("model", MODELS)
def test_points_projected_onto_the_borders_of_pixels_are_left_open(model: str) -> None:
    """Points whose projection is a border to the last bit: no answer of single precision would be more than a guess."""
    camera = CAMERAS[model]
    border = np.stack(np.meshgrid(np.arange(100, 500, 7) + 0.5, np.arange(100, 400, 7.0)), axis=-1).reshape(-1, 2)
    rays, seen = unproject(camera, border)
    xyz = np.ascontiguousarray((rays[seen] * 9.0).T, np.float32)
    assert (single_precision(camera, np.eye(4), xyz) == UNSURE).mean() > 0.95


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38, 2e6])
def test_what_is_no_number_or_too_far_is_left_open_or_beyond(bad: float) -> None:
    for camera in CAMERAS.values():
        for axis in range(3):
            xyz = np.full((3, 40), 1.0, np.float32)
            xyz[axis] = bad
            result, expected = single_precision(camera, POSE, xyz), double_precision(camera, POSE, xyz)
            assert ((result == UNSURE) | (result == expected)).all()


@pytest.mark.parametrize("model", MODELS)
def test_the_optical_axis_has_a_pixel_in_single_precision_too(model: str) -> None:
    camera = CAMERAS[model]
    axis = np.array([[0.0, 1e-21, -1e-30, 0.0], [0.0, 1e-22, 1e-25, 0.0], [5.0, 2.0, 7.0, -3.0]], np.float32)
    result, expected = single_precision(camera, np.eye(4), axis), double_precision(camera, np.eye(4), axis)
    assert expected.max() >= 0
    np.testing.assert_array_equal(result[:3], expected[:3])
    assert result[3] in (expected[3], UNSURE)


def test_points_nearer_than_the_shift_are_left_open() -> None:
    pose = se3.perturbation(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    near = np.array([[-1.0], [0.0], [0.9]], np.float32)
    assert single_precision(CAMERAS["pinhole"], pose, near).tolist() == [UNSURE]


def test_an_image_of_too_many_pixels_to_number_is_left_to_double_precision() -> None:
    camera = build("pinhole", **(SENSOR | {"width": 5000, "height": 4000, "cx": 2500.0, "cy": 2000.0, "fx": 3000.0}))
    in_view = np.abs(cloud(4, 1000, 1.0)) + np.float32(0.5)
    result, expected = single_precision(camera, np.eye(4), in_view), double_precision(camera, np.eye(4), in_view)
    assert (result[expected >= 0] == UNSURE).all()


COMPILES_OR_LOADS = """
import sys, numpy as np
from coec.geometry import se3
from coec.geometry.cameras import build
from coec.geometry.mutual_information import BinnedFrames, mutual_information
rng = np.random.default_rng(0)
frames = BinnedFrames(
    build("double_sphere", width=512, height=512, fx=160.0, fy=160.0, cx=255.5, cy=255.5, xi=-0.2, alpha=0.6),
    rng.normal(scale=10.0, size=(3, 200_000)).astype(np.float32), rng.integers(0, 32, 200_000).astype(np.uint8),
    np.array([0, 200_000]), rng.integers(0, 33, (1, 512 * 512 + 1)).astype(np.uint8), 32, 32,
)
for k in range(20):
    pose = se3.perturbation(rng.normal(scale=0.2, size=6))
    print(mutual_information(frames, pose).mi[0].hex())
"""


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_loads_the_cache_agree_to_the_bit(tmp_path: Path) -> None:
    """The loop of single precision is compiled with leave to round differently each time; what comes out may not."""
    service = str(Path(__file__).parents[2] / "service")
    environment = {"PYTHONPATH": service, "XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    results = [
        subprocess.run(
            [sys.executable, "-c", COMPILES_OR_LOADS], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    ]
    assert results[0] == results[1]
    assert len(set(results[0].split())) == 20
