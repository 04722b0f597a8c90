"""Objectives along each axis about a pose: what a search sees of them from afar and up close."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgesAlone, build_edges
from coec.calibration.objective.mutual_information import Objective
from coec.calibration.solver import ESTIMATORS, WindowData
from coec.calibration.types import Matrix4
from coec.config import CalibrationConfig
from coec.geometry import se3

CROWDING = 1.5
"""Power by which the points of a scan crowd about its middle, so that a peak of 0.2 degrees is not stepped over."""


@dataclass(frozen=True, slots=True)
class ScanSpan:
    """Half-widths of a scan, radians and metres, and the number of values per axis (odd, so that the pose itself is
    among them)."""

    rotation_rad: float
    translation_m: float
    points: int


WIDE = ScanSpan(radians(25.0), 0.6, 121)
"""What a search from the far end of the protocol (METHOD, section 2) has to cross."""

NARROW = ScanSpan(radians(2.0), 0.1, 81)
"""Shows the peaks: that of mutual information is degrees wide, that of the edges a fraction of a degree."""


class ScoreFunction(Protocol):
    """An objective that is maximised."""

    def score(self, T_camera_lidar: Matrix4) -> float:
        """Its value at a pose (4, 4)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """An objective along one axis of the perturbation, 0 (rx) to 5 (tz): offsets (n,), radians or metres, and scores
    (n,)."""

    axis: int
    offsets: NDArray[np.float64]
    scores: NDArray[np.float64]

    @property
    def best_offset(self) -> float:
        """Where the highest score is."""
        return float(self.offsets[np.argmax(self.scores)])


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Wide and narrow scans of one objective, one of each per axis."""

    wide: tuple[Scan, ...]
    narrow: tuple[Scan, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectiveLandscape:
    """The score of an objective."""

    objective: Objective

    def score(self, T_camera_lidar: Matrix4) -> float:
        """See `ScoreFunction.score`."""
        return self.objective.evaluate(T_camera_lidar).score


def landscapes(window_data: WindowData, config: CalibrationConfig) -> dict[str, ScoreFunction]:
    """The objectives on a window, by name: the fused one, its two cues alone (`mi` is also the paper's objective),
    and the configured one if it is another.

    Raises:
        CalibrationError: the window has no edges or no depth.
    """
    kinds = dict.fromkeys(("fused", "mi", config.objective.kind))
    by_kind: dict[str, ScoreFunction] = {
        kind: ObjectiveLandscape(ESTIMATORS[kind](window_data, config).objective) for kind in kinds
    }
    edges = build_edges(window_data.window.pairs, window_data.points, window_data.greys(), window_data.window.rig)
    return {**by_kind, "edges": ObjectiveLandscape(EdgesAlone(edges.whole, edges.blur_rad))}


def scan(landscape: ScoreFunction, centre: Matrix4, axes: int, span: ScanSpan) -> tuple[Scan, ...]:
    """One scan for each of the first `axes` axes through `centre` (4, 4)."""
    even = np.linspace(-1.0, 1.0, span.points)
    steps = np.sign(even) * np.abs(even) ** CROWDING
    scans = []
    for axis in range(axes):
        offsets = steps * (span.rotation_rad if axis < 3 else span.translation_m)
        poses = [se3.perturb(centre, offset * np.eye(6)[axis]) for offset in offsets]
        scans.append(Scan(axis, offsets, np.array([landscape.score(pose) for pose in poses])))
    return tuple(scans)


def views(
    named: Mapping[str, ScoreFunction], centre: Matrix4, axes: int, on_progress: Callable[[int, str], None]
) -> dict[str, Views]:
    """Wide and narrow scans of every landscape; `heard(done, name)` counts the landscapes."""
    seen = {}
    for done, (name, landscape) in enumerate(named.items(), start=1):
        seen[name] = Views(scan(landscape, centre, axes, WIDE), scan(landscape, centre, axes, NARROW))
        on_progress(done, name)
    return seen
