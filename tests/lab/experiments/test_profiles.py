"""Scans along the axes, on hills whose summit is known."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec_lab.experiments.objective_scans import NARROW, WIDE, ScanSpan, scan, views

REFERENCE = se3.exp(np.array([1.2, -1.2, 1.2, 0.1, -0.3, 0.8]))


class _Hill:
    """Highest where the perturbation from the reference is `summit`."""

    def __init__(self, summit: NDArray[np.float64]) -> None:
        self._summit = summit

    def score(self, T_camera_lidar: Matrix4) -> float:
        return -float(np.sum((se3.difference(T_camera_lidar, REFERENCE) - self._summit) ** 2))


SUMMIT = np.array([radians(1.0), radians(-1.0), radians(0.4), 0.05, -0.08, 0.02])


@pytest.mark.parametrize("span", [WIDE, NARROW])
@pytest.mark.parametrize("axes", [3, 6])
def test_scan_finds_the_summit_on_every_axis(span: ScanSpan, axes: int) -> None:
    scans = scan(_Hill(SUMMIT), REFERENCE, axes, span)
    assert [one.axis for one in scans] == list(range(axes))
    for one in scans:
        reach = span.rotation_rad if one.axis < 3 else span.translation_m
        assert one.offsets[[0, -1]] == pytest.approx([-reach, reach])
        assert 0.0 in one.offsets
        assert len(one.offsets) == len(one.scores) == span.points
        nearest = np.abs(one.offsets - SUMMIT[one.axis]).min()
        assert abs(one.best_offset - SUMMIT[one.axis]) == pytest.approx(nearest)


def test_points_crowd_about_the_pose() -> None:
    steps = np.diff(scan(_Hill(SUMMIT), REFERENCE, 1, WIDE)[0].offsets)
    assert steps[len(steps) // 2] < radians(0.1)
    assert steps[0] > radians(0.5)


def test_views_are_those_of_every_landscape() -> None:
    received: list[tuple[int, str]] = []
    named = {"one": _Hill(SUMMIT), "other": _Hill(-SUMMIT)}
    seen = views(named, REFERENCE, 3, lambda done, name: received.append((done, name)))
    assert list(seen) == ["one", "other"]
    assert received == [(1, "one"), (2, "other")]
    assert seen["one"].narrow[0].best_offset > 0 > seen["other"].narrow[0].best_offset
