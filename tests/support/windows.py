"""Windows of one small camera and their results, as a recorder would write them; every number is seeded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Rig,
    SweepTiming,
)
from coec.config import CalibrationConfig, SearchConfig
from coec.geometry import cameras, se3
from coec.io.mcap.windows import RecordedWindow, WindowWriter
from coec.schemas.replies import CalibrationResult, MetricReply, Reason, Transform, Verdict

WIDTH, HEIGHT = 64, 48


START_NS = 1_600_000_000_123_456_789


CONFIGURATION = CalibrationConfig(search=SearchConfig(dof=6, rotation_deg=7.3))


def a_rig(*, mask: bool = True) -> Rig:
    rng = np.random.default_rng(3)
    return Rig(
        pair="front",
        camera=cameras.build(
            "double_sphere", width=WIDTH, height=HEIGHT, fx=21.1, fy=0.1 + 0.2, cx=31.5, cy=23.7, xi=-0.2, alpha=0.59
        ),
        camera_frame="camera",
        lidar_frame="lidar",
        T_camera_lidar_nominal=se3.exp(rng.normal(size=6)),
        T_lidar_ego=se3.exp(rng.normal(size=6)),
        mask=rng.random((HEIGHT, WIDTH)) > 0.2 if mask else None,
        sweep=SweepTiming(0.104493824, -1, 1 / 3),
    )


def a_pair(index: int, *, raw: bool = False, motion: bool = True, points: int = 300) -> FramePair:
    rng = np.random.default_rng(100 + index)
    pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    depth = cv2.imencode(".png", rng.integers(0, 65535, (12, 16), dtype=np.uint16))[1].tobytes()
    stamp_ns = START_NS + index * 7_000_000_001
    image = (
        EncodedImage(ImageFormat.BGR8, WIDTH, HEIGHT, pixels.tobytes())
        if raw
        else EncodedImage(ImageFormat.JPEG, WIDTH, HEIGHT, jpeg)
    )
    return FramePair(
        CameraFrame(stamp_ns, "camera", image, depth=EncodedImage(ImageFormat.PNG, 16, 12, depth)),
        LidarFrame(
            stamp_ns - 3_000_000,
            "lidar",
            rng.normal(size=(points, 3)).astype(np.float32) * 20,
            intensity=rng.random(points).astype(np.float32),
            ring=rng.integers(0, 64, points, dtype=np.uint16),
            time_offset_s=(rng.random(points) * 0.1 - 0.05).astype(np.float32),
        ),
        EgoMotion(stamp_ns, "base", (0.1 + 0.2, -1e-17, 8.0), (1 / 3, -2 / 3, 1e-300)) if motion else None,
    )


BLACK = EncodedImage(ImageFormat.BGR8, WIDTH, HEIGHT, bytes(3 * WIDTH * HEIGHT))


def a_window(
    path: Path, pairs: list[FramePair] | None = None, rig: Rig | None = None, *, packed: bool = False
) -> RecordedWindow:
    rig = rig or a_rig()
    reported = {"vehicle": "car"}
    writer = WindowWriter(path, rig, rig.T_camera_lidar_nominal, path.stem, CONFIGURATION, reported, packed=packed)
    for pair in pairs if pairs is not None else [a_pair(i) for i in range(3)]:
        writer.add(pair)
    return writer.finish()


def a_result(window_id: str = "front-1", reasons: tuple[Reason, ...] = ()) -> CalibrationResult:
    six = (0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
    return CalibrationResult(
        vehicle="car",
        pair="front",
        camera_frame="camera",
        lidar_frame="lidar",
        window_id=window_id,
        data_stamp_ns=START_NS,
        pairs=3,
        camera_from_lidar=Transform(
            matrix=((1, 0, 0, 0.1 + 0.2), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
            translation_m=(0.3, 0, 0),
            quaternion_xyzw=(0, 0, 0, 1),
        ),
        correction=six,
        sigma=(*six[:3], None, None, None),
        correction_rad_m=six,
        noise=((None,) * 6,) * 6,
        systematic={"stamps": six},
        correlation_pitch_height=None,
        correlation_yaw_side=None,
        independent_looks=2.5,
        solved=(True, True, True, False, False, False),
        unobservable=(False, False, False, False, False, False),
        status="failed" if reasons else "accepted",
        verdict=Verdict(decision="failed" if reasons else "accepted", reasons=reasons),
        metrics={"overlap": MetricReply(value=0.97, limit=0.5, at_least=True, passed=True)},
        score=0.5,
        score_at_start=0.4,
        mi=0.5,
        overlap=0.97,
        points_in_view=900,
        evaluations=40,
        stop_reason="tolerance_reached",
        first_derivative=(*six[:3], None, None, None),
        second_derivative=(*six[:3], None, None, None),
        compensation={"done": 3},
        depth_identity="precomputed",
        config_hash="0123456789abcdef",
    )
