"""Drives of a rig on which sensors are knocked, as data: when, which sensors, and by how much.

All faults of one drive number share a street, so the frames of a sensor that did not move are the same in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import degrees, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.types import RigGraph
from coec.calibration.types import Matrix4
from coec.evaluation.rig_evidence import WINDOW
from coec.evaluation.rig_looks import ROWS, graph_of
from coec.geometry import se3
from coec.geometry.vectors import random_direction
from coec.simulation.faults import SensorFault, StepFault
from coec.simulation.rig_drive import RigDrive, RigDriveConfig

LIDAR = "roof"
"""Name of the rig's LiDAR; the rig has four fisheyes and one LiDAR of 64 beams."""

AT_S = (16.0, 22.0)
"""Sensors are knocked at a random time within these, seconds of the drive: after two or three looks at every pair."""

AFTER_S = 60.5
"""Driving after the knock: as long as an alarm may take, and long enough that the last pair is begun."""

STEP_RAD = radians(1.0)

FIRST_SEED = 1_760_001
"""Beyond all seeds from which anything was learned."""


@dataclass(frozen=True)
class DisplacedRigDrive:
    """A drive by its number.

    Attributes:
        camera: model of every camera, `fisheyeW`.
    """

    number: int
    camera: str

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.camera}_{FIRST_SEED + self.number}"

    @cached_property
    def _sampled(self) -> tuple[float, tuple[str, str], dict[str, NDArray[np.float64]]]:
        rng = np.random.default_rng([FIRST_SEED, self.number])
        one, other = (str(name) for name in rng.permutation(RigDriveConfig().drive().cameras)[:2])
        at_s = float(rng.uniform(*AT_S))
        turns = {name: STEP_RAD * random_direction(rng) for name in (one, other, LIDAR)}
        return at_s, (one, other), turns

    @property
    def at_s(self) -> float:
        """When sensors are knocked."""
        return self._sampled[0]

    @property
    def cameras(self) -> tuple[str, str]:
        """The cameras that may be knocked: a fault takes the first alone, or both."""
        return self._sampled[1]

    @cached_property
    def right(self) -> RigDrive:
        """As the rig was built."""
        return self._config(()).drive()

    @cached_property
    def displaced(self) -> RigDrive:
        """Both cameras and the LiDAR turned, each about an axis of its own."""
        faults = []
        for name, turn in self._sampled[2].items():
            rx, ry, rz = (degrees(angle) for angle in turn)
            faults.append(SensorFault(name, StepFault(self.at_s, float("inf"), rx=rx, ry=ry, rz=rz)))
        return self._config(tuple(faults)).drive()

    @cached_property
    def graph(self) -> RigGraph:
        """As the rig was built."""
        return graph_of(self.right, LIDAR)

    @cached_property
    def served(self) -> dict[str, Matrix4]:
        """Served extrinsic (4, 4) of each pair: off the truth by as much as windows are (`WINDOW`)."""
        rng = np.random.default_rng([FIRST_SEED, self.number, 1])
        return {edge.name: se3.perturb(edge.T_a_b, WINDOW * rng.normal(size=6)) for edge in self.graph.edges}

    def _config(self, faults: tuple[SensorFault, ...]) -> RigDriveConfig:
        seconds = self.at_s + AFTER_S
        return RigDriveConfig(
            seed=FIRST_SEED + self.number, seconds=seconds, camera=self.camera, ego_hz=20.0, faults=faults, rows=ROWS
        )  # fmt: skip
