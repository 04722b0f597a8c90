"""A window of the synthetic street, with exact depth, for everything that needs a scene with a known truth."""

import numpy as np
import pytest

from coec.adapters.depth.maps import open_depth
from coec.adapters.images.codec import GreyImages
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.frames.pairing import Pairer
from coec.calibration.objective.edges import EdgeWitness, build_edges
from coec.calibration.ports import DepthModel
from coec.calibration.types import FramePair, Window
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


@pytest.fixture(scope="session")
def sharp_street() -> Window:
    """The same street at three times the resolution: 0.23° per pixel. With coarser ones its edges hardly tell pitch
    from height."""
    return pairs_of("synthetic:?seed=3&frames=10&width=960")[1]


@pytest.fixture(scope="session")
def sharp_edges(sharp_street: Window) -> EdgeWitness:
    """The edge witness of the sharp street."""
    rig, pairs, images = sharp_street.rig, sharp_street.pairs, GreyImages(LimitsConfig())
    return build_edges(
        pairs,
        lambda frame, chosen: compensate(pairs[frame], rig, enabled=True, chosen=chosen),
        [images.grey(pair.camera) for pair in pairs],
        rig,
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
