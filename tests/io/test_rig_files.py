"""The rig: from configuration, to JSON and back."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from coec.calibration.types import Rig, SweepTiming
from coec.config import CameraConfig, CameraIntrinsics, EgoConfig, LidarConfig, PairConfig, SweepConfig
from coec.errors import ConfigError, WindowError
from coec.geometry import cameras, se3
from coec.io.rig_files import mask_to_png, rig_from_json, rig_of, rig_to_json

T = ((0.0, -1.0, 0.0, 0.1), (0.0, 0.0, -1.0, 0.2), (1.0, 0.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
PINHOLE = CameraIntrinsics(model="pinhole", width=40, height=30, fx=20, fy=21, cx=19.5, cy=14.5)


def a_config(**changes: object) -> PairConfig:
    camera = {"key": "front/image", "intrinsics": PINHOLE, **changes.pop("camera", {})}  # type: ignore[dict-item]
    values: dict[str, object] = {
        "name": "front",
        "camera": CameraConfig.model_validate(camera),
        "lidar": LidarConfig(key="front/points", frame_id="os", sweep=SweepConfig(period_s=0.1, stamp_azimuth_deg=90)),
        "ego": EgoConfig(key="front/odometry", T_lidar_ego=T),
        "T_camera_lidar": T,
    }
    return PairConfig.model_validate({**values, **changes})


def test_a_configuration_becomes_a_rig(tmp_path: Path) -> None:
    mask = np.full((30, 40), 255, np.uint8)
    mask[20:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    rig = rig_of(a_config(camera={"mask": tmp_path / "mask.png", "frame_id": "cam"}))
    assert rig.camera == cameras.build("pinhole", width=40, height=30, fx=20, fy=21, cx=19.5, cy=14.5)
    assert (rig.pair, rig.camera_frame, rig.lidar_frame) == ("front", "cam", "os")
    assert np.array_equal(rig.T_camera_lidar_nominal, np.array(T))
    assert np.array_equal(rig.T_lidar_ego, np.array(T))
    assert rig.sweep == SweepTiming(0.1, -1, math.pi / 2)
    assert rig.mask is not None
    assert rig.mask.dtype == np.bool_
    assert np.array_equal(rig.mask, mask > 0)


def test_the_frame_of_the_clouds_is_reported_where_it_is_another() -> None:
    assert rig_of(a_config()).cloud is None
    rig = rig_of(a_config(lidar=LidarConfig(key="k", cloud_frame_id="base_link", T_cloud_lidar=T)))
    assert rig.cloud is not None
    assert (rig.cloud.frame_id, rig.lidar_frame) == ("base_link", "lidar")
    back = rig_from_json(rig_to_json(rig), None).cloud
    assert back is not None
    assert np.array_equal(back.T_cloud_lidar, np.array(T))


def test_a_mask_in_colour_ignores_only_what_is_black(tmp_path: Path) -> None:
    mask = np.zeros((30, 40, 3), np.uint8)
    mask[:10, :, 2] = 1
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    rig = rig_of(a_config(camera={"mask": tmp_path / "mask.png"}))
    assert rig.mask is not None
    assert rig.mask.sum() == 10 * 40


def test_without_ego_motion_and_sweep_timing(tmp_path: Path) -> None:
    del tmp_path
    rig = rig_of(a_config(ego=None, lidar=LidarConfig(key="front/points")))
    assert np.array_equal(rig.T_lidar_ego, np.eye(4))
    assert rig.sweep is None


def test_what_cannot_be_used_is_refused_by_name(tmp_path: Path) -> None:
    skewed = ((1.0, 0.1, 0.0, 0.0), *T[1:])
    with pytest.raises(ConfigError, match="pair front, T_camera_lidar is not a rigid"):
        rig_of(a_config(T_camera_lidar=skewed))
    with pytest.raises(ConfigError, match=r"ego\.T_lidar_ego is not a rigid"):
        rig_of(a_config(ego=EgoConfig(key="k", T_lidar_ego=skewed)))
    with pytest.raises(ConfigError, match=r"camera\.intrinsics: pinhole: unknown intrinsics k1"):
        rig_of(a_config(camera={"intrinsics": PINHOLE.model_copy(update={"k1": 0.1})}))
    with pytest.raises(ConfigError, match="cannot read mask"):
        rig_of(a_config(camera={"mask": tmp_path / "absent.png"}))
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ConfigError, match="neither JPEG nor PNG"):
        rig_of(a_config(camera={"mask": tmp_path / "text.png"}))
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((3, 4), np.uint8))
    with pytest.raises(ConfigError, match="4 x 3 px, the camera 40 x 30 px"):
        rig_of(a_config(camera={"mask": tmp_path / "small.png"}))


@pytest.mark.parametrize("model", list(cameras.MODELS))
def test_json_gives_back_the_same_bits(model: str) -> None:
    values = {"width": 40, "height": 30, "fx": 0.1 + 0.2, "fy": 21.1, "cx": 19.5, "cy": 1 / 3}
    extra = {
        "xi": 0.3,
        "alpha": 0.51,
        "beta": 1.1,
        "k1": -0.09,
        "k2": 0.01,
        "k3": 1e-3,
        "k4": 1e-4,
        "k5": 1e-5,
        "k6": 1e-6,
        "p1": 1e-4,
        "p2": 0.0,
    }
    known = cameras.MODELS[model].parameters
    camera = cameras.build(model, **values, **{key: value for key, value in extra.items() if key in known})
    rng = np.random.default_rng(7)
    rig = Rig(
        "front",
        camera,
        "cam",
        "os",
        se3.exp(rng.normal(size=6)),
        se3.exp(rng.normal(size=6)),
        rng.random((30, 40)) > 0.5,
        SweepTiming(0.1 + 0.2, 1, -math.pi / 3),
    )
    assert rig.mask is not None
    back = rig_from_json(json.loads(json.dumps(rig_to_json(rig))), mask_to_png(rig.mask))
    assert (back.camera, back.sweep, back.pair) == (rig.camera, rig.sweep, rig.pair)
    assert back.T_camera_lidar_nominal.tobytes() == rig.T_camera_lidar_nominal.tobytes()
    assert back.T_lidar_ego.tobytes() == rig.T_lidar_ego.tobytes()
    assert back.mask is not None
    assert np.array_equal(back.mask, rig.mask)


def test_a_damaged_document_says_where() -> None:
    document = rig_to_json(rig_of(a_config()))
    with pytest.raises(WindowError, match="camera: fx"):
        rig_from_json({**document, "camera": {**document["camera"], "fx": -1}}, None)
    with pytest.raises(WindowError, match="rigid"):
        rig_from_json({**document, "T_lidar_ego": [[0.0] * 4] * 4}, None)
    with pytest.raises(WindowError, match="damaged"):
        rig_from_json(document, b"no image")
    with pytest.raises(WindowError, match="damaged"):
        rig_from_json([], None)
    assert rig_from_json({**document, "from_a_newer_version": 1}, None).pair == "front"
