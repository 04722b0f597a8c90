"""Figures: that they are drawn whatever the outcomes, and always the same."""

from __future__ import annotations

from math import radians

import cv2
import numpy as np

from coec_lab.experiments import plots
from coec_lab.experiments.solve_experiments import sphere_directions
from coec_lab.experiments.solve_statistics import SolveOutcome, Trial


def _outcome(angle_deg: float, accepted: bool) -> SolveOutcome:
    error = np.array([radians(angle_deg), 0.0, 0.0, 0.0, 0.0, 0.0])
    return SolveOutcome(
        Trial(np.eye(4), None, 1.0), np.eye(4), error, radians(angle_deg), 0.0, angle_deg / 0.5, accepted
    )


MIXED = [_outcome(0.1, True), _outcome(0.2, False), _outcome(9.0, True), _outcome(170.0, False), _outcome(0.0, True)]


def _size(png: bytes) -> tuple[int, int]:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.std() > 5
    return picture.shape[1], picture.shape[0]


def test_bullseye_has_a_disc_per_sphere_and_a_target() -> None:
    sphere = sphere_directions(len(MIXED))
    one = plots.bullseye(MIXED, {"rotation": sphere}, "title")
    two = plots.bullseye(MIXED, {"rotation": sphere, "translation": sphere}, "title")
    assert _size(two)[0] > 1.4 * _size(one)[0]


def test_equal_figures_are_equal_bytes() -> None:
    sphere = {"rotation": sphere_directions(len(MIXED))}
    assert plots.bullseye(MIXED, sphere, "title") == plots.bullseye(MIXED, sphere, "title")


def test_bullseye_of_one_start() -> None:
    assert plots.bullseye(MIXED[:1], {"rotation": sphere_directions(1)}, "") != plots.bullseye(
        MIXED[2:3], {"rotation": sphere_directions(1)}, ""
    )


def test_methods_stand_side_by_side() -> None:
    sphere = sphere_directions(len(MIXED))
    two = plots.compared({"mi": MIXED, "fused": MIXED[::-1]}, sphere, "title")
    three = plots.compared({"mi": MIXED, "fused": MIXED[::-1], "intensity": MIXED}, sphere, "title")
    assert _size(three)[0] > 1.2 * _size(two)[0]
