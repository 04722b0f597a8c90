"""When a camera moved, asked of pairs between those of a window: to a pair, and no closer than they can tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibration.search.test_global_search import away_from
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.objective.edges import build_edges
from coec.calibration.search import change_point as searched
from coec.calibration.search.change_point import ChangePoint, DatedEdges, StepTime, step_time
from coec.calibration.types import FramePair, Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.io.images import GreyImages

WINDOW = (0, 3, 6, 9)
"""Pairs of the street that are the window's; the others lie between."""


def moved(pair: FramePair, T_before: Matrix4, T_after: Matrix4, window: Window) -> FramePair:
    """The pair, motion-compensated, as if the mount had moved before it: to move the sweep by S⁻¹ is to move the mount
    by S."""
    back = se3.inverse(T_after) @ T_before
    xyz_m = compensate(pair, window.rig, enabled=True) @ back[:3, :3].T + back[:3, 3]
    return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m.astype(np.float32)))


class Displaced:
    """A street within which the mount moves before a pair: edges of those pairs that are asked for."""

    def __init__(self, street: Window, first_late: int, size_deg: float) -> None:
        self.T_before = street.T_camera_lidar_start
        self.T_after = away_from(self.T_before, size_deg, seed=first_late)
        ends = [self.T_before if i < first_late else self.T_after for i in range(len(street.pairs))]
        self.pairs = [moved(pair, self.T_before, T, street) for pair, T in zip(street.pairs, ends, strict=True)]
        self.requested: list[int] = []
        self._rig = street.rig
        split = sum(frame < first_late for frame in WINDOW)
        self.change = ChangePoint(split, self.T_before, self.T_after, gain=10.0, support=10.0, likeness=1.0)

    def edges(self, pairs: Sequence[FramePair]) -> DatedEdges:
        images = GreyImages(LimitsConfig())
        greys = (images.grey(pair.camera) for pair in pairs)
        result = build_edges(pairs, lambda i, selected: pairs[i].lidar.xyz_m[selected], greys, self._rig)
        return DatedEdges(tuple(pair.stamp_ns for pair in pairs), result)

    def observation(self, pairs: Sequence[FramePair]) -> DatedEdges:
        self.requested += [pair.stamp_ns for pair in pairs]
        return self.edges(pairs)

    def reported(
        self,
        change: ChangePoint | None = None,
        observation: Callable[[Sequence[FramePair]], DatedEdges | None] | None = None,
        between: Sequence[int] = (1, 2, 4, 5, 7, 8),
    ) -> StepTime:
        own = self.edges([self.pairs[frame] for frame in WINDOW])
        return step_time(
            change or self.change, own, [self.pairs[frame] for frame in between], observation or self.observation
        )

    def frames(self, reported: StepTime) -> tuple[int, int]:
        stamps_ns = [pair.stamp_ns for pair in self.pairs]
        return stamps_ns.index(reported.last_before_ns), stamps_ns.index(reported.first_after_ns)


@pytest.mark.parametrize("first_late", [2, 3, 5, 8])
def test_the_change_lies_between_two_pairs_of_all(sharp_street: Window, first_late: int) -> None:
    street = Displaced(sharp_street, first_late, 3.0)
    assert street.frames(street.reported()) == (first_late - 1, first_late)


def test_a_split_that_is_one_pair_of_the_window_off_is_put_right(sharp_street: Window) -> None:
    street = Displaced(sharp_street, 5, 3.0)
    for off in (-1, 1):
        wrong = replace(street.change, first_late=street.change.first_late + off)
        assert street.frames(street.reported(wrong)) == (4, 5)


def test_a_pose_that_the_window_determines_badly_is_detected_among_the_pairs_between(sharp_street: Window) -> None:
    """As of a single pair before the change, which fits another pose as well."""
    street = Displaced(sharp_street, 3, 3.0)
    astray = replace(street.change, T_before=away_from(street.T_before, 2.0, seed=77))
    reported = street.reported(astray)
    assert street.frames(reported)[1] == 3
    assert np.degrees(se3.rotation_angle_rad(reported.T_before @ se3.inverse(street.T_before))) < 1.0


def test_without_pairs_between_the_window_determines_as_closely_as_it_can(sharp_street: Window) -> None:
    street = Displaced(sharp_street, 5, 3.0)
    assert street.frames(street.reported(between=())) == (3, 6)
    assert street.frames(street.reported(observation=lambda _: None)) == (3, 6)


def test_pairs_that_hardly_distinguish_the_poses_leave_the_time_open(sharp_street: Window) -> None:
    street = Displaced(sharp_street, 5, 0.05)
    last_before, first_after = street.frames(street.reported())
    assert first_after - last_before > 3


def test_so_many_at_a_time_are_checked_and_none_twice(sharp_street: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    street = Displaced(sharp_street, 5, 3.0)
    monkeypatch.setattr(searched, "AT_ONCE", 2)
    assert street.frames(street.reported()) == (4, 5)
    assert len(street.requested) == len(set(street.requested)) > 2
