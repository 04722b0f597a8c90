"""An extrinsic to be exported."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.adapters.exports.extrinsic import ExportedExtrinsic, ExtrinsicOrigin
from coec.config import CameraIntrinsics
from coec.geometry import se3

Matrix = NDArray[np.float64]

EXPORT_CAMERA = CameraIntrinsics(
    model="double_sphere", width=1400, height=1300, fx=700.5, fy=701.5, cx=699.5, cy=650.5, xi=-0.2, alpha=0.6
)


def exported_extrinsic(
    xi: Matrix, warnings: tuple[str, ...] = (), camera: CameraIntrinsics | None = EXPORT_CAMERA
) -> ExportedExtrinsic:
    """A camera that looks forward, turned and moved by a vector (6,), in a parent 1.7 m below the LiDAR."""
    forward = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]])
    T_parent_lidar = se3.exp(np.array([0.02, -0.3, 0.5, 0.9, 0.1, 1.7]))
    origin = ExtrinsicOrigin("vehicle", "front", "0.1.0", "estimated", "front-12", 12_000_000_000, "ab12", warnings)
    covariance = np.diag([1e-7, 2e-7, 3e-7, 1e-4, 2e-4, 3e-4])
    return ExportedExtrinsic(se3.exp(xi) @ forward, covariance, "base_link", "cam0", T_parent_lidar, camera, origin)
