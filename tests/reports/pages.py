"""A page of every kind, of made-up data: what browsers and readers are shown in tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from coec.adapters.files.conversions import result_of
from coec.calibration.figures import FIGURES
from coec.calibration.types import (
    CameraFrame,
    Decision,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Metric,
    Reason,
    Window,
)
from coec.reports.calibration_page import calibration_page
from coec.reports.page import Page
from coec.reports.provenance import Made
from coec.schemas.replies import CalibrationReport
from estimates import RIG, estimate

EVIL = "<script>alert(1)</script>'\"><img src=http://evil/x onerror=alert(2)>"
MADE = Made("coec calibrate window.mcap --output out", 1_760_000_000 * 10**9, {"coec": "0.1.0"}, "Linux x86_64")
S = 1_000_000_000


def png(width: int = 160, height: int = 90, seed: int = 0) -> bytes:
    """A picture that is no surface of one colour."""
    image = np.random.default_rng(seed).integers(0, 255, (height // 10, width // 10, 3), dtype=np.uint8)
    return bytes(cv2.imencode(".png", cv2.resize(image, (width, height)))[1])


def window() -> Window:
    """Two pairs of nothing much."""
    pairs = tuple(
        FramePair(
            CameraFrame(stamp, "camera", EncodedImage(ImageFormat.PNG, 160, 90, png(seed=stamp))),
            LidarFrame(stamp, "lidar", np.full((2, 3), stamp, np.float32)),
        )
        for stamp in (S, 2 * S)
    )
    return Window("front-2", RIG, RIG.T_camera_lidar_nominal, pairs)


def calibration_report(*, accepted: bool = True, vehicle: str = "truck") -> CalibrationReport:
    """With every figure that a verdict may rest on; half of them fail where it is refused."""
    made = estimate(2 * S)
    names = [*FIGURES]
    metrics = tuple(
        Metric(name, 1.5 if accepted or number % 2 else 0.5, 1.0, at_least=True) for number, name in enumerate(names)
    )
    reasons = () if accepted else tuple(Reason(m.name, f"{m.name} says no") for m in metrics if not m.passed)
    verdict = replace(
        made.verdict, decision=Decision.ACCEPTED if accepted else Decision.FAILED, metrics=metrics, reasons=reasons
    )
    result = result_of(replace(made, verdict=verdict), RIG, vehicle)
    sigma = (0.031, 0.0284, 0.05, None, None, None)
    return CalibrationReport(**{**dict(result), "sigma": sigma}, elapsed_s={"load": 0.5, "search": 2.5, "total": 3.0})


def calibration(folder: Path, *, accepted: bool = True, vehicle: str = "truck") -> Page:
    """Of `coec calibrate`, with pictures."""
    paths = [folder / "overlay_before.png", folder / "overlay_after.png", folder / "close_ups.png"]
    for number, path in enumerate(paths):
        path.write_bytes(png(640, 360, number))
    report = calibration_report(accepted=accepted, vehicle=vehicle)
    return calibration_page(report, window(), (1.0, 0.0, -2.0, 0.0, 0.0, 0.0), paths, ["a remark"], MADE)
