"""Vehicles with several cameras and LiDARs: where each sensor sits, and when it measures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from coec.calibration.types import Matrix4
from coec.geometry.se3 import rotation_exp
from coec.simulation.lidar import LIDARS, LidarModel
from coec.simulation.scan import Turn, even_deg

NEAR = LidarModel(
    Turn(even_deg(-52.0, 52.0, 32), columns=900), reach_m=30.0, nearest_m=0.3, noise_m=0.02, divergence_rad=0.003
)
"""A short-range LiDAR that sees nearly a hemisphere, with angles and reach of common blind-spot sensors."""


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A fisheye where it was mounted.

    Attributes:
        T_ego_camera: (4, 4).
        phase: when it exposes, as a share of the period of its pictures.
    """

    name: str
    T_ego_camera: Matrix4
    phase: float


@dataclass(frozen=True, slots=True, eq=False)
class MountedLidar:
    """A LiDAR where it was mounted.

    Attributes:
        T_ego_lidar: (4, 4).
        phase: when the middle of its turn is, as a share of its period.
    """

    name: str
    T_ego_lidar: Matrix4
    model: LidarModel
    phase: float


@dataclass(frozen=True, slots=True)
class RigLayout:
    """The sensors of a vehicle, with unique names."""

    cameras: tuple[MountedCamera, ...]
    lidars: tuple[MountedLidar, ...]
    half_view_deg: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all sensors, cameras first."""
        return (*(camera.name for camera in self.cameras), *(lidar.name for lidar in self.lidars))

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Every camera with every LiDAR."""
        return tuple((camera.name, lidar.name) for camera in self.cameras for lidar in self.lidars)


def _camera(
    name: str, heading_deg: float, down_deg: float, at_m: tuple[float, float, float], phase: float
) -> MountedCamera:
    """A camera that looks towards a heading (counted from ahead to the left) and down."""
    turn = rotation_exp(np.array([0.0, 0.0, np.deg2rad(heading_deg)]))
    nod = rotation_exp(np.array([0.0, np.deg2rad(down_deg), 0.0]))
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    transform = np.eye(4)
    transform[:3, :3] = np.einsum("ij,jk,kl->il", turn, nod, ahead)
    transform[:3, 3] = at_m
    return MountedCamera(name, transform, phase)


def _lidar(
    name: str, turned_deg: tuple[float, float, float], at_m: tuple[float, float, float], model: LidarModel, phase: float
) -> MountedLidar:
    """A LiDAR that is turned from looking ahead by a rotation vector about x, y, z."""
    transform = np.eye(4)
    transform[:3, :3] = rotation_exp(np.deg2rad(np.array(turned_deg)))
    transform[:3, 3] = at_m
    return MountedLidar(name, transform, model, phase)


FOUR_FISHEYES = RigLayout(
    cameras=(
        _camera("front", 1.0, 8.0, (1.95, 0.02, 1.68), 0.02),
        _camera("left", 91.0, 12.0, (1.15, 0.62, 1.70), 0.77),
        _camera("rear", -178.5, 9.0, (0.25, -0.03, 1.69), 0.52),
        _camera("right", -89.0, 11.0, (1.20, -0.63, 1.70), 0.27),
    ),
    lidars=(
        _lidar("roof", (0.4, -0.6, 1.0), (1.20, 0.0, 2.00), LIDARS["64"], 0.0),
        _lidar("near_left", (-3.0, 1.0, 88.0), (1.30, 1.00, 1.05), NEAR, 0.13),
        _lidar("near_right", (3.0, 1.0, -91.0), (1.28, -1.00, 1.05), NEAR, 0.37),
    ),
    half_view_deg=95.0,
)
"""Fisheyes of 190° on the four edges of a roof rack, each exposed when the beam of the roof LiDAR passes its axis; a
64-beam LiDAR between them; and a free-running short-range LiDAR on each flank. The cameras are on the roof to be near
the LiDAR, because their depth differs more the further away they are (METHOD, section 1). As on real mounts, no angle
is a round number."""

RIGS: Mapping[str, RigLayout] = MappingProxyType({"four-fisheyes": FOUR_FISHEYES})
