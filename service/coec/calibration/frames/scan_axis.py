"""The axis about which a LiDAR scans, and a window whose clouds have it as z axis.

Points that follow each other on a scan line lie on a cone about the axis, so that the chord between them is
perpendicular to it. Drivers that exchange or turn axes give clouds whose scan lines are no lines of elevation, along
which range edges are found.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import cos, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.pairing import azimuth_offsets_s
from coec.calibration.types import FramePair, LidarFrame, Matrix4, Window
from coec.geometry import linalg, se3

CHORD_RAD = (1e-5, radians(1.5))
"""Length of the chords between successive points of a scan line: longer ones lead to another line, or over a hole."""

ALONG = (0.5, 0.1, 0.03)
"""A chord is left out if its share along the axis is larger than this, in one pass after another: it leads from one
line to the next."""

LEAST_ORDER = 0.1
"""Largest mean square of that share, over that along another axis, of clouds with scan lines. A cloud without order has
1."""

MOST_ALONG = 0.9
"""Largest mean cosine between the points and the axis. All chords of a cloud that covers a narrow cone are
perpendicular to where it looks, in whatever order its points are."""

ALIGNED_RAD = radians(2.0)
"""Clouds whose axis is this near to z stay as they are."""


def scan_axis(sweeps: Sequence[LidarFrame]) -> NDArray[np.float64] | None:
    """(3,) the axis of the scan lines, a unit vector with the z axis on its side; None if successive points form no
    lines."""
    directions = [_directions(sweep) for sweep in sweeps]
    chords = np.concatenate([_chords(*of_sweep) for of_sweep in directions])
    if len(chords) == 0:
        return None
    selected = chords
    for most in ALONG:
        spreads = linalg.eigen(np.einsum("ni,nj->ij", selected, selected).tolist())
        axis = np.array(spreads[-1][1])
        if spreads[-1][0] > LEAST_ORDER * spreads[-2][0]:
            return None
        selected = chords[np.abs(chords @ axis) < most]
    if float(np.mean(np.concatenate([np.abs(seen @ axis) for seen, _ in directions]))) > MOST_ALONG:
        return None
    return axis if axis[2] >= 0.0 else -axis


def _directions(sweep: LidarFrame) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(N, 3) unit vectors to the points in the order of their scan lines, and (N,) the lines, as far as known."""
    ring = np.zeros(len(sweep.xyz_m), np.int64) if sweep.ring is None else sweep.ring.astype(np.int64)
    order = np.argsort(ring, kind="stable")
    xyz_m = sweep.xyz_m[order].astype(np.float64)
    return xyz_m / np.maximum(np.linalg.norm(xyz_m, axis=1, keepdims=True), 1e-9), ring[order]


def _chords(directions: NDArray[np.float64], ring: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n, 3) unit vectors from one direction to the next on its scan line."""
    chords = np.diff(directions, axis=0)
    length = np.linalg.norm(chords, axis=1)
    together = (length > CHORD_RAD[0]) & (length < CHORD_RAD[1]) & (np.diff(ring) == 0)
    return np.asarray(chords[together] / length[together, None])


def upright_turn(window: Window) -> Matrix4:
    """(4, 4) the least turn of the LiDAR's frame that makes the axis of its scan lines the z axis; the identity if it
    is, or if there are no scan lines."""
    axis = scan_axis([pair.lidar for pair in window.pairs])
    if axis is None or axis[2] > cos(ALIGNED_RAD):
        return np.eye(4)
    about = np.cross(axis, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(about))
    return se3.transform_from(se3.rotation_exp(about * (np.arctan2(sine, axis[2]) / sine)), np.zeros(3))


def with_turned_clouds(window: Window, turn: Matrix4) -> Window:
    """The window with the frame of its LiDAR turned: p_turned = turn · p."""
    rig, back = window.rig, se3.inverse(turn)

    def turned(pair: FramePair) -> FramePair:
        sweep, times_s = pair.lidar, pair.lidar.time_offset_s
        if times_s is None and rig.sweep is not None:
            times_s = azimuth_offsets_s(sweep.xyz_m, rig.sweep).astype(np.float32)
        xyz_m = np.einsum("ni,ji->nj", sweep.xyz_m.astype(np.float64), turn[:3, :3]).astype(np.float32)
        return replace(pair, lidar=replace(sweep, xyz_m=xyz_m, time_offset_s=times_s))

    return replace(
        window,
        rig=replace(
            rig,
            T_camera_lidar_nominal=rig.T_camera_lidar_nominal @ back,
            T_lidar_ego=turn @ rig.T_lidar_ego,
            sweep=None,
        ),
        T_camera_lidar_start=window.T_camera_lidar_start @ back,
        pairs=tuple(turned(pair) for pair in window.pairs),
        between=tuple(turned(pair) for pair in window.between),
    )
