"""Frames count for as long as anybody holds them, whoever that is."""

from __future__ import annotations

import gc

import numpy as np

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame
from coec.service.ingest.pair_stream import FrameBudget, frame_bytes


def sweep(points: int) -> LidarFrame:
    return LidarFrame(0, "lidar", np.zeros((points, 3), np.float32))


def test_what_is_held_anywhere_counts_until_the_last_holder_lets_go() -> None:
    budget = FrameBudget(1000)
    image = CameraFrame(0, "camera", EncodedImage(ImageFormat.MONO8, 4, 25, bytes(100)))
    first = sweep(50)
    assert budget.admit(image)
    assert budget.admit(first)
    assert budget.bytes == 700
    held = [FramePair(image, first)]
    del image, first
    gc.collect()
    assert budget.bytes == 700
    held.clear()
    gc.collect()
    assert budget.bytes == 0


def test_what_does_not_fit_is_refused_and_does_not_count() -> None:
    budget = FrameBudget(1000)
    retained = sweep(50)
    assert budget.admit(retained)
    assert not budget.admit(sweep(50))
    assert budget.bytes == frame_bytes(retained)
    assert budget.admit(sweep(30))
    gc.collect()
    assert budget.admit(sweep(30)), "nobody has held the one before"


def test_motion_takes_no_room() -> None:
    budget = FrameBudget(0)
    assert budget.admit(EgoMotion(0, "ego", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert not budget.admit(sweep(1))
