"""Figures of an assessed network: that they are drawn whatever it gives."""

from __future__ import annotations

from math import radians

import cv2
import numpy as np
import pytest

from coec_lab.experiments import plots
from coec_lab.experiments.depth_quality import DepthQuality, Pairing
from coec_lab.experiments.objective_scans import Scan


def _size(png: bytes) -> tuple[int, int]:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.std() > 3
    return picture.shape[1], picture.shape[0]


def _pairing(count: int) -> Pairing:
    rng = np.random.default_rng(1)
    return Pairing(rng.uniform(0, 30, (count, 2)), rng.uniform(2, 80, count), rng.normal(size=count), 0.9)


def test_joint() -> None:
    _size(plots.joint(np.eye(8, dtype=np.int64) * 50, "title"))


def test_curves_without_a_peak() -> None:
    offsets = np.linspace(-0.2, 0.2, 9)
    scans = tuple(Scan(axis, offsets, np.zeros(9)) for axis in range(3))
    none = np.full(3, np.nan)
    quality = DepthQuality((_pairing(9),), 1.0, 0.9, np.full(3, radians(0.5)), none, none, scans, np.eye(4, dtype=int))
    _size(plots.curves(quality, "title"))


@pytest.mark.parametrize("count", [0, 1, 200])
def test_wide_frames_stand_above_their_map_others_next_to_it(count: int) -> None:
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    values[0, 0] = np.nan
    wide = _size(plots.frame(np.full((30, 90, 3), 90, np.uint8), values, _pairing(count), "title"))
    square = _size(plots.frame(np.full((60, 60, 3), 90, np.uint8), values, _pairing(count), "title"))
    assert wide[0] < 1.8 * wide[1]
    assert square[0] > 1.8 * square[1]
