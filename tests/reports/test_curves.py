"""Curves: that they are drawn whatever the figures are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coec_lab.experiments import plots
from coec_lab.experiments.evaluation_schema import FramesPoint, SlicePoint, Spread
from coec_lab.experiments.objective_scans import Scan, Views

FLAT = Spread(median=0.01, p95=0.02, max=0.03)
EXACT = Spread(median=0.0, p95=0.0, max=0.0)


def _size(png: bytes) -> tuple[int, int]:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.std() > 5
    return picture.shape[1], picture.shape[0]


def _views(axes: int) -> Views:
    offsets = np.linspace(-0.1, 0.1, 11)
    scans = tuple(Scan(axis, offsets, np.exp(-(offsets**2))) for axis in range(axes))
    return Views(scans, scans)


def test_landscape_has_a_second_pair_of_rows_for_translations() -> None:
    turned = plots.landscape(dict.fromkeys(("fused", "mi", "edges"), _views(3)), "title")
    moved = plots.landscape(dict.fromkeys(("fused", "mi", "edges"), _views(6)), "title")
    assert _size(moved)[1] > 1.8 * _size(turned)[1]


def test_flat_landscape() -> None:
    flat = tuple(Scan(axis, np.linspace(-1.0, 1.0, 5), np.zeros(5)) for axis in range(3))
    _size(plots.landscape({"mi": Views(flat, flat)}, "title"))


@pytest.mark.parametrize("with_translation", [False, True])
@pytest.mark.parametrize("errors", [FLAT, EXACT])
def test_error_against_frames(with_translation: bool, errors: Spread) -> None:
    points = [
        FramesPoint(frames=count, subsets=5, hit_rate=0.8, rotation_deg=errors, translation_m=errors, sigma_deg=None)
        for count in (1, 2, 5)
    ]
    _size(plots.error_against_frames(points, with_translation, "title"))


def test_error_against_one_number_of_frames() -> None:
    point = FramesPoint(frames=1, subsets=1, hit_rate=1.0, rotation_deg=FLAT, translation_m=FLAT, sigma_deg=0.6)
    _size(plots.error_against_frames([point], False, "title"))


@pytest.mark.parametrize("with_translation", [False, True])
def test_error_against_slice(with_translation: bool) -> None:
    points = [
        SlicePoint(
            length_s=length_s, slices=5, pairs=2.0, solves=20, hit_rate=0.8, rotation_deg=FLAT, translation_m=FLAT,
            sigma_deg=1.1,
        )
        for length_s in (7.5, 15.0, 120.0)
    ]  # fmt: skip
    _size(plots.error_against_slice(points, with_translation, "title"))
