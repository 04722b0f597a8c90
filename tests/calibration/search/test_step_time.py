"""When a camera moved, asked of frames between those of a window: to a frame, and no closer than they can tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.search.test_change_point import turned
from calibration.search.test_global_search import away_from
from coec.calibration.objective.edges import EdgeWitness
from coec.calibration.search import step_time as searched
from coec.calibration.search.change_point import ChangePoint
from coec.calibration.search.step_time import DatedEdges, step_time
from coec.calibration.types import FramePair, Window
from coec.geometry.edges.alignment import EdgeFrames

WINDOW = (0, 3, 6, 9)
"""Frames of the street that are the window's; the others lie between."""


class Between:
    """Frames of a witness, which are looked at when they are asked for."""

    def __init__(self, edges: EdgeFrames, unreadable: Sequence[int] = ()) -> None:
        self._edges = edges
        self._unreadable = unreadable
        self.asked: list[int] = []

    def dated(self, frames: Sequence[int]) -> DatedEdges:
        first = self._edges.first_point
        points = np.concatenate([np.arange(first[frame], first[frame + 1]) for frame in frames])
        ends = np.cumsum([0, *(first[frame + 1] - first[frame] for frame in frames)])
        part = replace(
            self._edges,
            xyz_m=np.ascontiguousarray(self._edges.xyz_m[:, points]),
            weight=self._edges.weight[points],
            first_point=ends.astype(np.int64),
            maps=self._edges.maps[list(frames)],
        )
        return DatedEdges(tuple(frames), part)

    def __call__(self, pairs: Sequence[FramePair]) -> DatedEdges | None:
        self.asked += [pair.stamp_ns for pair in pairs]
        usable = [pair.stamp_ns for pair in pairs if pair.stamp_ns not in self._unreadable]
        return self.dated(usable) if usable else None


def at(*frames: int) -> list[Any]:
    """Pairs of which only the stamp matters."""
    return [SimpleNamespace(stamp_ns=frame) for frame in frames]


def change(edges: EdgeWitness, street: Window, first_late: int, size_deg: float) -> tuple[EdgeFrames, ChangePoint]:
    T_before = street.T_camera_lidar_start
    T_after = away_from(T_before, size_deg, seed=first_late)
    moved = turned(edges, first_late, 10, T_before, T_after).sharp
    of_window = sum(frame < first_late for frame in WINDOW)
    return moved, ChangePoint(of_window, T_before, T_after, gain=10.0, support=10.0, likeness=1.0)


@pytest.mark.parametrize("first_late", [2, 3, 4, 6, 8])
def test_the_change_lies_between_two_frames_of_all(
    sharp_street: Window, sharp_edges: EdgeWitness, first_late: int
) -> None:
    edges, found = change(sharp_edges, sharp_street, first_late, 2.0)
    between = Between(edges)
    told = step_time(found, between.dated(WINDOW), at(1, 2, 4, 5, 7, 8), between)
    assert (told.last_before_ns, told.first_after_ns) == (first_late - 1, first_late)


def test_a_split_that_is_one_frame_of_the_window_off_is_put_right(
    sharp_street: Window, sharp_edges: EdgeWitness
) -> None:
    edges, found = change(sharp_edges, sharp_street, 5, 2.0)
    between = Between(edges)
    for off in (-1, 1):
        wrong = replace(found, first_late=found.first_late + off)
        told = step_time(wrong, between.dated(WINDOW), at(1, 2, 4, 5, 7, 8), between)
        assert (told.last_before_ns, told.first_after_ns) == (4, 5)


def test_without_frames_between_the_window_tells_as_closely_as_it_can(
    sharp_street: Window, sharp_edges: EdgeWitness
) -> None:
    edges, found = change(sharp_edges, sharp_street, 5, 2.0)
    between = Between(edges, unreadable=range(10))
    for pairs in ([], at(1, 2, 4, 5, 7, 8)):
        told = step_time(found, between.dated(WINDOW), pairs, between)
        assert (told.last_before_ns, told.first_after_ns) == (3, 6)


def test_frames_that_hardly_tell_the_poses_apart_leave_the_time_open(
    sharp_street: Window, sharp_edges: EdgeWitness
) -> None:
    edges, found = change(sharp_edges, sharp_street, 5, 0.05)
    between = Between(edges)
    told = step_time(found, between.dated(WINDOW), at(1, 2, 4, 5, 7, 8), between)
    assert told.last_before_ns < 4 <= 5 < told.first_after_ns


def test_so_many_at_a_time_are_looked_at_and_none_twice(
    sharp_street: Window, sharp_edges: EdgeWitness, monkeypatch: pytest.MonkeyPatch
) -> None:
    edges, found = change(sharp_edges, sharp_street, 5, 0.05)
    whole = Between(edges)
    expected = step_time(found, whole.dated(WINDOW), at(1, 2, 4, 5, 7, 8), whole)
    monkeypatch.setattr(searched, "AT_ONCE", 1)
    between = Between(edges)
    assert step_time(found, between.dated(WINDOW), at(1, 2, 4, 5, 7, 8), between) == expected
    assert len(between.asked) == len(set(between.asked))
