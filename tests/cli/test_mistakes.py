"""A mistake in a `dataset.yaml`: `calibrate` and `check` name it, and `--fix` writes a manifest that is accepted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from ruamel.yaml import YAML

from cli.conftest import Coec
from coec.calibration.types import CameraFrame, LidarFrame, Mistake, Recognition, Rig, Window
from coec.geometry import cameras, se3
from coec.geometry.cameras import Camera, scaled
from coec.io.recordings.layouts import open_source
from coec.io.recordings.window_cutting import LoadedWindow
from coec.recording import mistake_of_recording
from support.simulated_drives import rendered_source

STREET = "sim:seed=5&seconds=48&camera_hz=0.17&lidar_hz=0.17&camera=pinhole640x320&lidar=32&depth=yes"
"""The drive of `tests/calibration/search/test_mistakes.py`."""

FRAMES = 5


def manifest(folder: Path, camera: Camera, rows: NDArray[np.float64]) -> Path:
    """The street as files, with intrinsics and a pose as a person wrote them."""
    folder.mkdir()
    frames: list[str] = []
    sweep: LidarFrame | None = None
    for message in rendered_source(STREET).messages():
        if isinstance(message, LidarFrame):
            sweep = message
        if len(frames) == FRAMES:
            break
        if isinstance(message, CameraFrame) and sweep is not None and message.depth is not None:
            name, image = str(len(frames)), f"{len(frames)}.{message.image.format.value}"
            (folder / image).write_bytes(message.image.data)
            (folder / f"{name}-depth.png").write_bytes(message.depth.data)
            np.savez(folder / f"{name}.npz", xyz=sweep.xyz_m)
            frames.append(
                f"  - {{image: {image}, cloud: {name}.npz, depth: {name}-depth.png, stamp_ns: {message.stamp_ns}}}"
            )
    lens = ", ".join(f"{key}: {value}" for key, value in cameras.intrinsics_of(camera).items())
    (folder / "dataset.yaml").write_text(
        f"# the roof of truck 7\npair: front\ncamera: {{model: {cameras.name_of(camera)}, {lens}}}  # data sheet\n"
        + "\n".join(["T_camera_lidar:", *(f"  - {row}" for row in rows.tolist())])
        + "  # of the workshop\n"
        + "\n".join(["frames:", *frames])
        + "\n"
    )
    return folder


@pytest.fixture(autouse=True)
def mistakes_unsought() -> None:
    """They are looked for."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    return rendered_source(STREET).rig


def test_an_inverse_pose_is_named_and_fixed(coec: Coec, tmp_path: Path, rig: Rig) -> None:
    folder = manifest(tmp_path / "a", rig.camera, se3.inverse(rig.T_camera_lidar_nominal))
    outcome = coec("calibrate", folder, "--depth", "stereo", "--json")
    assert outcome.status == 1
    mistake = outcome.document["mistake"]
    assert mistake["code"] == "inverse_pose"
    assert "write it under T_lidar_camera" in mistake["text"]
    assert not (folder / "dataset.fixed.yaml").exists()

    before = (folder / "dataset.yaml").read_text()
    outcome = coec("calibrate", folder, "--depth", "stereo", "--fix")
    assert outcome.status == 1
    assert "T_camera_lidar is called T_lidar_camera" in outcome.err
    after_verdict = outcome.out.partition("\nverdict ")[2].splitlines()[1]
    assert after_verdict.startswith("  probable cause: "), "the cause is named before what it makes other figures say"
    fixed = folder / "dataset.fixed.yaml"
    assert fixed.read_text() == before.replace("T_camera_lidar", "T_lidar_camera")
    assert (folder / "dataset.yaml").read_text() == before
    assert open_source(str(fixed)).rig.T_camera_lidar_nominal == pytest.approx(rig.T_camera_lidar_nominal, abs=1e-12)
    assert coec("calibrate", fixed, "--depth", "stereo", "--json").document["mistake"] is None


def test_check_names_intrinsics_of_another_size_and_fixes_them(coec: Coec, tmp_path: Path, rig: Rig) -> None:
    half = scaled(rig.camera, 0.5, 0.5)._replace(width=rig.camera.width, height=rig.camera.height)
    folder = manifest(tmp_path / "a", half, rig.T_camera_lidar_nominal)
    outcome = coec("check", folder, "--depth", "stereo", "--json", "--fix")
    assert outcome.status == 1
    assert outcome.document["mistake"]["code"] == "image_scale"
    assert outcome.document["remarks"][0]["code"] == "image_scale"
    fixed = (folder / "dataset.fixed.yaml").read_text()
    assert YAML().load(fixed)["camera"]["fx"] == pytest.approx(rig.camera.fx)
    assert "# data sheet" in fixed
    (folder / "dataset.fixed.yaml").write_text("another: file\n")
    again = coec("check", folder, "--depth", "stereo", "--fix")
    assert "exists and is another" in again.err
    assert (folder / "dataset.fixed.yaml").read_text() == "another: file\n"


def test_only_a_manifest_can_be_fixed(coec: Coec) -> None:
    outcome = coec("calibrate", STREET, "--depth", "stereo", "--fix")
    assert (outcome.status, "--fix writes a corrected dataset.yaml" in outcome.err) == (2, True)


@pytest.mark.parametrize(
    ("recognised", "named", "cause"),
    [
        ("clocks_apart", "inverse_pose", "clocks_apart"),
        ("several_cameras", "clock_offset", "several_cameras"),
        ("viewpoint", "clock_offset", "viewpoint"),
        ("viewpoint", None, "viewpoint"),
        ("transform_changes", "clock_offset", "transform_changes"),
        ("transform_changes", "inverse_pose", "inverse_pose"),
        ("header_clock", "already_compensated", "header_clock"),
        ("header_clock", "focal_length", "focal_length"),
        ("camera_info_empty", None, None),
    ],
)
def test_what_was_recognised_is_named_before_what_it_resembles(
    rig: Rig, recognised: str, named: str | None, cause: str | None
) -> None:
    window = Window("front-1", rig, rig.T_camera_lidar_nominal, (), 0.1)
    loaded = LoadedWindow(window, None, "car", {}, (Recognition(recognised, "As recognised.", "warn"),))
    of_window = named and Mistake(named, "", 9.0, 1.0, rig.camera, rig.T_camera_lidar_nominal, correctable=False)
    mistake = mistake_of_recording(loaded, of_window or None)
    assert (None if mistake is None else mistake.code) == cause
    assert mistake is None or mistake is of_window or mistake.text.endswith(" As recognised.")
