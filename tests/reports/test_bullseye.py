"""Discs of starts and ends: that they lie where they should, and are told without colours."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest

from coec.reports.page import Page, Section, render
from coec_lab.experiments.evaluation_charts import bullseye, end_places, rim_of, start_places
from coec_lab.experiments.solve_experiments import sphere_directions
from coec_lab.experiments.solve_statistics import SolveOutcome, Trial


def outcome(pitch_deg: float, yaw_deg: float, *, accepted: bool) -> SolveOutcome:
    error = np.radians([pitch_deg, yaw_deg, 0.0, 0.0, 0.0, 0.0])
    size = float(np.linalg.norm(error))
    return SolveOutcome(Trial(np.eye(4), None, 1.0), np.eye(4), error, size, 0.0, size / radians(0.5), accepted)


HIT, REFUSED_HIT = outcome(0.2, 0.0, accepted=True), outcome(0.0, 0.2, accepted=False)
MISS, ACCEPTED_MISS = outcome(-3.0, 0.0, accepted=False), outcome(0.0, -9.0, accepted=True)
ALL = [ACCEPTED_MISS, HIT, MISS, REFUSED_HIT]


def test_directions_are_flattened_about_the_axis_that_the_camera_points_along() -> None:
    places = start_places(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(places[:, 1], [0.0, np.sqrt(0.5), np.sqrt(0.5), 1.0])
    np.testing.assert_allclose(places[1:3, 0], [0.0, np.pi / 2])


def test_ends_lie_as_the_picture_moves_and_far_ones_on_the_rim() -> None:
    assert rim_of(ALL) == 10.0
    (angle, radius), *_ = end_places([outcome(1.0, 0.0, accepted=True)], 2.0)
    assert (angle, radius) == pytest.approx((np.pi / 2, 1.0)), "pitch is up"
    assert end_places(ALL, 5.0)[0, 1] == 5.0


def test_every_start_is_a_dot_and_what_would_have_been_served_wrongly_lies_on_top() -> None:
    discs = bullseye({"": ALL}, {"starts": sphere_directions(4)})
    starts, target = discs.items
    assert [dot.description for dot in starts.dots][-1] == "start 0: ends 9.00° off"
    assert len(starts.dots) == len(target.dots) == 4
    assert {name for _, name in discs.legend} == {
        "hits, accepted: 1", "hits, refused: 1", "misses, refused: 1", "misses, accepted: 1"
    }  # fmt: skip
    forms = {(kind.shape, kind.full) for kind, _ in discs.legend}
    assert len(forms) == 4, "told apart without a colour"
    assert "2 of 4 lie within 0.5°" in target.description
    page = render(Page("k", "t", (), (Section("s", (discs,)),)))
    assert page.count("<title>start ") == 8
    assert f'aria-label="{target.title}: {target.description}"' in page


def test_targets_of_several_methods_have_one_radius() -> None:
    discs = bullseye({"mi": ALL, "fused": [HIT] * 4}, {"starts": sphere_directions(4)})
    assert len(discs.items) == 4
    assert "rim: 10°" in discs.items[3].title
