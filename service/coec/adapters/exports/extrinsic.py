"""What is exported: a transform between two named frames, its uncertainty, and where it comes from.

Each format writes the direction and the order that its readers expect, and states both in the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.conversions import number_or_null
from coec.config import CameraIntrinsics
from coec.geometry import se3

Matrix = NDArray[np.float64]

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ExtrinsicOrigin:
    """Where an extrinsic comes from.

    Attributes:
        version: of coec.
        provenance: `nominal`, `commissioned`, `estimated` or `restored`.
        window_id, data_stamp_ns, config_hash: of the window that it rests on; None if there is none.
        objections: why it is not accepted, one sentence each; empty if it is accepted.
    """

    vehicle: str
    pair: str
    version: str
    provenance: str
    window_id: str | None
    data_stamp_ns: int | None
    config_hash: str | None
    rejection_reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ExportedExtrinsic:
    """A camera's pose, ready to be written.

    Attributes:
        T_camera_lidar: (4, 4) maps LiDAR (x forward, y left, z up) to optical camera coordinates (x right, y down, z
            forward), metres.
        covariance: (6, 6) of its error about and along the camera axes, radians and metres: the true transform is
            exp(error)·T_camera_lidar. NaN for entries that are not known.
        parent, child: names of the frames; the child is the camera.
        T_parent_lidar: (4, 4) pose of the LiDAR in the parent; identity if the parent is the LiDAR.
        camera: intrinsics; None if they are not known.
        origin: see `Origin`.
    """

    T_camera_lidar: Matrix
    covariance: Matrix
    parent: str
    child: str
    T_parent_lidar: Matrix
    camera: CameraIntrinsics | None
    origin: ExtrinsicOrigin

    @property
    def T_child_parent(self) -> Matrix:
        """(4, 4) maps coordinates in the parent to optical camera coordinates."""
        return self.T_camera_lidar @ se3.inverse(self.T_parent_lidar)

    @property
    def T_parent_child(self) -> Matrix:
        """(4, 4) pose of the optical camera frame in the parent: what tf, URDF and most formats hold."""
        return self.T_parent_lidar @ se3.inverse(self.T_camera_lidar)

    @property
    def T_parent_body(self) -> Matrix:
        """(4, 4) pose in the parent of the camera's body frame (x forward, y left, z up; REP 103)."""
        return self.T_parent_child @ T_OPTICAL_BODY

    def remarks(self, direction: str) -> list[str]:
        """Comment lines for a file: the direction of its numbers in words, their uncertainty and their origin."""
        origin = self.origin
        lines = [
            f"{origin.pair} of {origin.vehicle}: {origin.provenance}, by coec {origin.version}",
            direction,
            self._sigma_line(),
            f"covariance of the error (rad, m; about the camera axes, row by row): {_numbers(self.covariance.ravel())}",
        ]
        if origin.window_id is not None:
            lines.append(
                f"window {origin.window_id}, data until {utc(origin.data_stamp_ns)}, configuration {origin.config_hash}"
            )
        if origin.rejection_reasons:
            lines.append(f"NOT ACCEPTED, exported by force: {' '.join(origin.rejection_reasons)}")
        return [_one_line(line) for line in lines]

    def document(self, direction: str) -> dict[str, object]:
        """The same facts as JSON values, for formats without comments."""
        origin = self.origin
        return {
            "direction": direction,
            "accepted": not origin.rejection_reasons,
            "objections": list(origin.rejection_reasons),
            "covariance_rad_m": [[number_or_null(value) for value in row] for row in self.covariance.tolist()],
            "vehicle": origin.vehicle,
            "pair": origin.pair,
            "provenance": origin.provenance,
            "window_id": origin.window_id,
            "data_stamp_ns": origin.data_stamp_ns,
            "config_hash": origin.config_hash,
            "version": origin.version,
        }

    def _sigma_line(self) -> str:
        sigma = np.sqrt(self.covariance.diagonal())
        axis_texts = [
            f"{name} {np.degrees(value):.4f} deg" if axis < 3 else f"{name} {value:.4f} m"
            for axis, (name, value) in enumerate(zip(AXES, sigma.tolist(), strict=True))
            if math.isfinite(value)
        ]
        return f"sigma about the camera axes: {', '.join(axis_texts)}" if axis_texts else "sigma: not known"


T_OPTICAL_BODY: Matrix = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Maps body coordinates (x forward, y left, z up) to optical ones (x right, y down, z forward): REP 103."""


def quaternion_wxyz(T: Matrix) -> list[float]:
    """Unit quaternion of a transform (4, 4), w first, w ≥ 0."""
    x, y, z, w = se3.quaternion_xyzw_from_rotation(T[:3, :3]).tolist()
    return [w, x, y, z]


def quaternion_xyzw(T: Matrix) -> list[float]:
    """Unit quaternion of a transform (4, 4), w last, w ≥ 0."""
    return [float(value) for value in se3.quaternion_xyzw_from_rotation(T[:3, :3])]


def roll_pitch_yaw(T: Matrix) -> list[float]:
    """[roll, pitch, yaw] in radians, R = Rz(yaw)·Ry(pitch)·Rx(roll), as in URDF and ROS.

    Yaw is taken first, then pitch and roll from the rest of the rotation. This is exact even for a pitch of a right
    angle, where yaw and roll turn about the same axis and only their sum is determined.
    """
    R = T[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    cosine, sine = math.cos(yaw), math.sin(yaw)
    forward = cosine * R[0] + sine * R[1]
    left = cosine * R[1] - sine * R[0]
    return [math.atan2(-left[2], left[1]), math.atan2(-R[2, 0], forward[0]), yaw]


def translation_m(T: Matrix) -> list[float]:
    """Last column of a transform (4, 4), metres."""
    return [float(value) for value in T[:3, 3]]


def utc(stamp_ns: int | None) -> str:
    """A stamp for people."""
    if stamp_ns is None:
        return "an unknown time"
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, tz=UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _one_line(text: str) -> str:
    """The text in one line and in ASCII, so that a comment with it cannot end early and every reader accepts it."""
    return " ".join(text.split()).encode("ascii", "replace").decode()


def _numbers(values: Matrix) -> str:
    return " ".join("?" if math.isnan(value) else f"{value:.6g}" for value in values.tolist())
