"""Describes a move of the camera within a window: by how much, when, and which of the window's pairs come after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import degrees

from coec.calibration.estimators import WindowData
from coec.calibration.objective.edges import EdgeCue, build_edges
from coec.calibration.search.change_point import ChangePoint
from coec.calibration.search.step_time import DatedEdges, step_time
from coec.calibration.types import FramePair, MovedWithin, Window
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3


def moved_within(change: ChangePoint, edges: EdgeCue, data: WindowData) -> MovedWithin:
    """The change that the edges of a window show, dated also by the pairs recorded between those of the window."""
    window = data.window
    stamps_ns = tuple(pair.stamp_ns for pair in window.pairs)
    step = step_time(change, DatedEdges(stamps_ns, edges), window.between, lambda pairs: _edges_of(pairs, data))
    pairs_after = sum(stamp_ns >= step.first_after_ns for stamp_ns in stamps_ns)
    return MovedWithin(step.last_before_ns, step.first_after_ns, pairs_after, step.T_before, step.T_after)


def move_text(moved: MovedWithin, window: Window) -> str:
    """By how much and when the camera moved, to be appended to a sentence that says that it moved."""
    turn_deg = degrees(se3.rotation_angle_rad(moved.T_after @ se3.inverse(moved.T_before)))
    before_s, after_s = (
        (stamp_ns - window.pairs[0].stamp_ns) / 1e9 for stamp_ns in (moved.last_before_ns, moved.first_after_ns)
    )
    return f", by {turn_deg:.1f}° between {before_s:.1f} and {after_s:.1f} s after its first pair"


def _edges_of(pairs: Sequence[FramePair], data: WindowData) -> DatedEdges | None:
    """The edges of some pairs; None if none are usable. These pairs were not decoded before, so any that cannot be
    decoded is left out."""
    seen = []
    for pair in pairs:
        try:
            seen.append((pair, data.images.grey(pair.camera)))
        except DecodeError:
            continue
    usable = [pair for pair, _ in seen]
    of = replace(data, window=replace(data.window, pairs=tuple(usable)))
    try:
        cue = build_edges(usable, of.points, (grey for _, grey in seen), data.window.rig)
    except CalibrationError:
        return None
    return DatedEdges(tuple(pair.stamp_ns for pair in usable), cue)
