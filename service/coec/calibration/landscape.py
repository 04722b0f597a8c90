"""The objective along each axis about a pose: what a search sees of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.values import Matrix4
from coec.geometry import se3

REACH_RAD, REACH_M = radians(6.0), 0.6
"""Half-widths of the scans: several times the width of the maximum of mutual information on every recording tried."""

POINTS = 61
"""Values per axis, the pose itself among them: a step of 0.2 degrees and of 2 cm."""


class Landscape(Protocol):
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


def scan(landscape: Landscape, centre: Matrix4, heard: Callable[[int, int], None]) -> tuple[Scan, ...]:
    """One scan for each of the six axes through `centre` (4, 4); `heard(done, total)` counts the scans."""
    scans = []
    for axis in range(6):
        offsets = np.linspace(-1.0, 1.0, POINTS) * (REACH_RAD if axis < 3 else REACH_M)
        poses = [se3.perturb(centre, offset * np.eye(6)[axis]) for offset in offsets]
        scans.append(Scan(axis, offsets, np.array([landscape.score(pose) for pose in poses])))
        heard(axis + 1, 6)
    return tuple(scans)
