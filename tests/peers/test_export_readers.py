"""What `coec export` writes, read by programs that are not ours: the same transform."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from coec.io.exports import FORMATS
from peers.environments import Peer, peer
from support.estimates import exported_extrinsic

TOLERANCE = 1e-12

WITHOUT_READER = {"tf", "json", "ros_camera_info"}
"""A command line, which tf2's publisher reads; a format of our own; and intrinsics, without a transform."""


@pytest.fixture(scope="module")
def readers() -> Iterator[Peer]:
    with peer("readers", "export_reader.py") as readers:
        yield readers


@pytest.mark.parametrize("name", sorted(FORMATS.keys() - WITHOUT_READER))
def test_others_read_the_same_transform(readers: Peer, name: str) -> None:
    for seed in range(20):
        reported = exported_extrinsic(np.random.default_rng(seed).uniform(-2.0, 2.0, 6))
        read = readers.query(format=name, text=FORMATS[name].text(reported, None))
        np.testing.assert_allclose(read["T_child_parent"], reported.T_child_parent, atol=TOLERANCE, rtol=0)
