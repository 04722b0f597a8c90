"""Instants of a rig: which frames belong together."""

from __future__ import annotations

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from dataclasses import replace

import numpy as np

from coec.calibration.types import CameraFrame, LidarFrame
from coec_lab.simulation.rig_drive import RigDrive, RigDriveConfig, instants, pair_of

pytestmark = pytest.mark.usefixtures("streets")

SMALL = RigDriveConfig(seed=4, seconds=3.0, camera="fisheye64", ego_hz=20.0)


def test_every_camera_has_a_picture_of_its_own_within_half_a_turn_of_the_sweep() -> None:
    drive = RigDrive(SMALL)
    result = instants(drive, "roof", 0.5)
    assert len(result) == 6
    assert np.diff([instant.sweep.stamp_ns for instant in result]).tolist() == [500_000_000] * 5
    for instant in result:
        assert set(instant.pictures) == set(drive.cameras)
        for camera, entry in instant.pictures.items():
            assert entry.stream == drive.stream(camera)
            assert abs(entry.stamp_ns - instant.sweep.stamp_ns) <= 50_000_000
    assert len({entry for instant in result for entry in instant.pictures.values()}) == 6 * 4


def test_an_instant_that_lacks_a_picture_is_left_out() -> None:
    drive = RigDrive(replace(SMALL, seconds=0.08))
    assert instants(drive, "roof", 0.5) == [], "the camera that is exposed before the first sweep has no picture yet"


def test_the_frames_of_an_instant_are_the_pair_that_the_service_makes_of_them() -> None:
    drive = RigDrive(SMALL)
    first, later = instants(drive, "roof", 1.0)[:2]
    motions = tuple(drive.message(entry) for entry in first.motions)
    sweep, picture = drive.message(first.sweep), drive.message(first.pictures["left"])
    assert isinstance(sweep, LidarFrame)
    assert isinstance(picture, CameraFrame)
    pair = pair_of(picture, sweep, motions)
    assert pair is not None
    assert pair.camera is picture
    assert pair.lidar is sweep
    assert pair.motion is not None
    assert pair.motion.stamp_ns == picture.stamp_ns, "at the exposure"
    assert pair_of(picture, drive.message(later.sweep), motions) is None, "a second apart"


def test_rows_without_a_picture_are_black_and_masked_and_the_others_are_rendered() -> None:
    from coec.config import LimitsConfig
    from coec.io.images import GreyImages

    drive = RigDrive(replace(SMALL, rows=(0.25, 0.5)))
    frame = drive.message(instants(drive, "roof", 1.0)[0].pictures["front"])
    assert isinstance(frame, CameraFrame)
    grey = GreyImages(LimitsConfig()).grey(frame)
    assert grey[20:30].mean() > 30
    assert max(grey[:12].max(), grey[36:].max()) < 20, "but for what JPEG spreads"
    mask = drive.mask("front")
    assert mask[20:28].any()
    assert not mask[:16].any()
    assert not mask[32:].any()
