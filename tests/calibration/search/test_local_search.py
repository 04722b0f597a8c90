"""The search on hills whose maximum is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.search.local_search import NEAR, FixedCentre, SearchResult, maximise, near, polish, polish_in_turn
from coec.calibration.types import Matrix4, Silence, StopReason
from coec.config import SearchConfig
from coec.geometry import se3

START = se3.perturbation(np.array([1.1, -1.3, 0.9, 0.2, -0.1, 0.3]))
SIX, THREE = SearchConfig(dof=6), SearchConfig(dof=3)


class Hill:
    """A bell over ξ from `START`, as wide as so many radians and metres, higher where rotations are small."""

    def __init__(self, top_deg: Sequence[float], top_m: Sequence[float] = (0.0, 0.0, 0.0), width_rad: float = 0.1):
        self.top = np.array([*np.radians(top_deg), *top_m])
        self.step_rad = 0.25 * width_rad
        self._widths = np.array([width_rad] * 3 + [10.0 * width_rad] * 3)
        self.visited: list[NDArray[np.float64]] = []

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        xi = se3.difference(T_camera_lidar, START)
        self.visited.append(xi)
        score = float(np.exp(-0.5 * (((xi - self.top) / self._widths) ** 2).sum()))
        return Evaluation(score, np.array([score]), score, 1.0, 1)

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        return [self.evaluate(pose) for pose in poses]


def separation_deg(result: SearchResult, hill: Hill) -> float:
    return float(np.degrees(np.abs(se3.difference(result.T_camera_lidar, START) - hill.top)[:3].max()))


@pytest.mark.parametrize("top_deg", [(0.0, 0.0, 0.0), (6.0, -7.0, 4.0), (-9.0, 1.0, 9.0)])
def test_the_top_is_detected_anywhere_in_the_box(top_deg: tuple[float, float, float]) -> None:
    hill = Hill(top_deg)
    result = maximise(hill, START, THREE, Silence())
    assert result.stop_reason is StopReason.TOLERANCE
    assert separation_deg(result, hill) < 0.01
    assert result.evaluations == len(hill.visited)


def test_the_same_hill_is_ascended_the_same_way() -> None:
    first, second = Hill((3.0, 2.0, -4.0)), Hill((3.0, 2.0, -4.0))
    ends = [maximise(hill, START, THREE, Silence()).T_camera_lidar for hill in (first, second)]
    assert ends[0].tobytes() == ends[1].tobytes()
    np.testing.assert_array_equal(first.visited, second.visited)


def test_nothing_beyond_the_box_is_visited_and_its_rim_is_reported() -> None:
    context = Hill((2.0 * THREE.rotation_deg, 0.0, 0.0), width_rad=0.5)
    result = maximise(context, START, THREE, Silence())
    assert result.stop_reason is StopReason.AT_BOUND
    rotations_deg = np.degrees(np.abs(context.visited))[:, :3]
    assert rotations_deg.max() <= np.sqrt(3.0) * THREE.rotation_deg + 1e-6


def test_three_degrees_of_freedom_leave_the_translation() -> None:
    hill = Hill((1.0, 1.0, 1.0), (0.2, 0.2, 0.2))
    maximise(hill, START, THREE, Silence())
    np.testing.assert_allclose(np.array(hill.visited)[:, 3:], 0.0, atol=1e-9)


def test_evaluations_run_out() -> None:
    result = maximise(Hill((6.0, 6.0, 6.0)), START, THREE.model_copy(update={"max_evaluations": 20}), Silence())
    assert result.stop_reason is StopReason.EVALUATIONS


def test_a_basin_is_polished_but_for_the_axes_that_are_retained() -> None:
    hill = Hill((1.0, -1.5, 2.0), (0.1, -0.05, 0.0))
    result = polish(hill, START, SIX, Silence(), constraint=FixedCentre((3, 4, 5), START))
    assert separation_deg(result, hill) < 0.01
    np.testing.assert_allclose(np.array(hill.visited)[:, 3:], 0.0, atol=1e-9)


def test_levels_in_turn_end_on_the_last_in_fewer_evaluations() -> None:
    def levels() -> list[Hill]:
        return [Hill((2.0, -2.0, 1.0)), Hill((2.3, -1.8, 1.1), width_rad=0.05), Hill((2.2, -1.9, 1.0), width_rad=0.02)]

    hills = levels()
    result = polish_in_turn(hills, START, THREE, Silence())
    assert separation_deg(result, hills[-1]) < 0.01
    assert result.evaluations == sum(len(hill.visited) for hill in hills)
    each_to_the_end = polish(levels()[0], START, THREE, Silence())
    for hill in levels()[1:]:
        each_to_the_end = polish(hill, each_to_the_end.T_camera_lidar, THREE, Silence(), each_to_the_end.evaluations)
    assert result.evaluations < each_to_the_end.evaluations


def test_near_is_a_share_of_the_hill_and_never_nearer_than_requested() -> None:
    hill = Hill((0.5, 0.5, -0.5))
    roughly = near(THREE, hill)
    assert roughly.tolerance_deg == pytest.approx(NEAR * np.degrees(hill.step_rad))
    assert hill.evaluate(polish(hill, START, roughly, Silence()).T_camera_lidar).score > 0.99
    coarse = THREE.model_copy(update={"tolerance_deg": 5.0})
    assert near(coarse, hill).tolerance_deg == 5.0
