"""Windows of a simulated street, with exact depth, for everything that needs a scene with a known truth."""

from collections.abc import Sequence

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.frames.pairing import Pairer
from coec.calibration.objective.edges import EdgeCue, build_edges
from coec.calibration.types import DepthModel, Window
from coec.config import DepthConfig, LimitsConfig, PairingConfig
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.recordings.layouts import RecordingSource
from coec.io.recordings.window_cutting import RECORDED_GAP_S
from support.simulated_drives import rendered_source

STREET = "sim:seed=1&seconds=40&camera_hz=0.2&lidar_hz=0.2&camera=fisheye320&lidar=32&depth=yes"
SHARP_STREET = "sim:seed=1&seconds=70&camera_hz=0.142857&lidar_hz=0.142857&camera=fisheye700&lidar=32&depth=yes"


def window_of(recording: RecordingSource, cameras: Sequence[int] | None = None) -> Window:
    """The window of all frames of a recording, or of the chosen camera frames; it starts at the recording's own
    calibration."""
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=True)
    pairs = [pair for message in recording.messages(cameras) for pair in pairer.push(message)]
    pairs += pairer.flush()
    return Window("street-0", recording.rig, recording.rig.T_camera_lidar_nominal.copy(), tuple(pairs))


@pytest.fixture(scope="session")
def street() -> Window:
    """Eight pairs, 40 m apart; it starts at the truth."""
    return window_of(rendered_source(STREET))


@pytest.fixture(scope="session")
def stereo() -> DepthModel:
    """Hands out the maps that come with the frames."""
    return open_depth(DepthConfig(model="stereo"), LimitsConfig())


@pytest.fixture(scope="session")
def sharp_street() -> Window:
    """Ten pairs of the same street, 60 m apart, at twice the resolution: 0.27° per pixel. With coarser ones its edges
    hardly tell pitch from height."""
    return window_of(rendered_source(SHARP_STREET))


@pytest.fixture(scope="session")
def sharp_edges(sharp_street: Window) -> EdgeCue:
    """The edge cue of the sharp street."""
    rig, pairs, images = sharp_street.rig, sharp_street.pairs, GreyImages(LimitsConfig())
    return build_edges(
        pairs,
        lambda frame, selected: compensate(pairs[frame], rig, enabled=True, selection=selected),
        [images.grey(pair.camera) for pair in pairs],
        rig,
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
