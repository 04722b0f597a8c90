"""A window of the synthetic street, with exact depth, for everything that needs a scene with a known truth."""

import numpy as np
import pytest

from coec.adapters.depth import open_depth
from coec.calibration.pairing import Pairer
from coec.calibration.ports import DepthModel
from coec.calibration.values import FramePair, Window
from coec.config import DepthConfig, LimitsConfig, PairingConfig
from coec.sources import open_source


def pairs_of(source: str) -> tuple[tuple[FramePair, ...], Window]:
    recording = open_source(source)
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairs = [pair for message in recording.messages() for pair in pairer.push(message)]
    pairs += pairer.flush()
    return tuple(pairs), Window("street-0", recording.rig, recording.rig.T_camera_lidar_nominal.copy(), tuple(pairs))


@pytest.fixture(scope="session")
def street() -> Window:
    """Eight pairs; it starts at the truth."""
    return pairs_of("synthetic:?seed=3&frames=8&width=320")[1]


@pytest.fixture(scope="session")
def stereo() -> DepthModel:
    """Hands out the maps that come with the frames."""
    return open_depth(DepthConfig(model="stereo"), LimitsConfig())


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
