"""The second witness of a check: what depth says of a pose that the edges accuse or cannot judge.

The edges are far sharper, and a network costs more than all the rest of a check. So depth is not used if the edges are
clear and confirm the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.check import Check, CheckInput
from coec.calibration.monitor.neighbourhood import REACH_RAD, ROTATION_DOF
from coec.calibration.objective.curvature import axis_derivatives
from coec.calibration.objective.mutual_information import SearchBox, build_mutual_information
from coec.calibration.ports import Silence
from coec.calibration.search.local_search import polish
from coec.calibration.types import Matrix4
from coec.config import CalibrationConfig
from coec.geometry import se3


@dataclass(frozen=True, slots=True, eq=False)
class DepthCue:
    """What mutual information says of a pose (Borer et al. 2023). Derivatives are over rx ry rz tx ty tz; equation (2)
    uses those of the rotations.

    Attributes:
        mi: equation (1), nats.
        first_derivative: (6,) ∂MI/∂ξ, nats per radian or metre.
        second_derivative: (6,) -∂²MI/∂ξ², nats per radian² or metre²; positive at a maximum.
        agreement_rad: angle between the local optimum of depth and that of the edges.
    """

    mi: float
    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]
    agreement_rad: float

    @property
    def f1(self) -> float:
        """Largest slope of the rotations, nats per radian."""
        return float(np.max(np.abs(self.first_derivative[:ROTATION_DOF])))

    @property
    def f2(self) -> float:
        """Least peakedness of the rotations, nats per radian²."""
        return float(np.min(self.second_derivative[:ROTATION_DOF]))


def depth_cue(evidence: CheckInput, seen: Check, pose: Matrix4, config: CalibrationConfig) -> DepthCue:
    """What depth says of `pose` (4, 4), at which the edges say `seen`.

    Raises:
        CalibrationError: a frame has no usable depth, or no point can come into view.
    """
    depth = build_mutual_information(
        evidence.features(), evidence.rig, pose, SearchBox(REACH_RAD, 0.0), config.objective
    )
    first_derivative, second_derivative = axis_derivatives(depth, pose)
    rotation = config.search.model_copy(update={"dof": ROTATION_DOF})
    there = polish(depth, seen.T_rotation, rotation, Silence()).T_camera_lidar
    return DepthCue(
        mi=depth.evaluate(pose).mi,
        first_derivative=first_derivative,
        second_derivative=second_derivative,
        agreement_rad=se3.rotation_angle_rad(seen.T_rotation @ se3.inverse(there)),
    )
