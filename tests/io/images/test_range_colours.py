"""Colours of ranges: they follow the scene, keep still while it does, and are told apart by everyone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coec.io.images import WHOLE_SCALE, RangeScale, scale_of, stable_scale

VISION = {
    "usual": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""What linear red, green and blue are to an eye (Machado, Oliveira, Fernandes 2009, severity 1)."""


@pytest.mark.parametrize("kind", VISION)
def test_ranges_a_quarter_of_the_scale_separate_differ_for_every_eye(kind: str) -> None:
    rgb = WHOLE_SCALE.colours_bgr(WHOLE_SCALE.range_at(np.linspace(0.0, 1.0, 33)))[:, ::-1] / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ VISION[kind].T, 0.0, 1.0)
    shown = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = cv2.cvtColor(shown[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0]
    separation = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    first, second = np.indices(separation.shape)
    assert separation[np.abs(first - second) >= 8].min() > 15.0


def test_the_ends_follow_the_ranges_at_round_steps() -> None:
    assert scale_of(np.linspace(2.4, 9.0, 500)) == RangeScale(2.0, 10.0)
    assert scale_of(np.linspace(6.0, 48.0, 500)) == RangeScale(5.0, 50.0)
    assert RangeScale(5.0, 50.0).ticks_m() == (5.0, 10.0, 20.0, 50.0)


def test_a_few_strays_and_the_vehicle_itself_move_no_end() -> None:
    room = np.linspace(2.4, 9.0, 500)
    assert scale_of(np.concatenate([room, [300.0, 500.0], np.full(400, 0.7)])) == scale_of(room)


def test_a_wall_is_no_rainbow_and_nothing_has_a_scale_too() -> None:
    wall = scale_of(np.random.default_rng(1).normal(7.0, 0.02, 1000))
    assert wall.furthest_m / wall.nearest_m >= 4.0
    assert scale_of(np.zeros(0)) == scale_of(np.full(3, 0.5)) == WHOLE_SCALE


def test_a_stream_keeps_its_colours_until_the_scene_is_another() -> None:
    """About a limit between two steps the scale does not go to and fro."""
    scale, seen = None, set()
    for furthest_m in (49.0, 51.0, 49.5, 50.5, 48.0, 52.0):
        scale = stable_scale(scale, scale_of(np.linspace(5.5, furthest_m, 2000) / 0.98))
        seen.add(scale)
    assert len(seen) == 1
    assert stable_scale(scale, scale_of(np.linspace(2.4, 9.0, 500))) == RangeScale(2.0, 10.0)


def test_beyond_the_ends_colours_are_those_of_the_ends() -> None:
    scale = RangeScale(5.0, 50.0)
    near, at_near, far, at_far = scale.colours_bgr(np.array([2.0, 5.0, 200.0, 50.0]))
    np.testing.assert_array_equal(near, at_near)
    np.testing.assert_array_equal(far, at_far)
