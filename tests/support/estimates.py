"""Results that nobody computed: an estimate, a commissioned baseline and an extrinsic for export."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import Accuracy, Baseline, MonitorLimits
from coec.calibration.monitor.sensor_faults import BANDS, BLOCK_COLUMNS, BLOCK_ROWS, SECTORS, SceneBaseline
from coec.calibration.types import Decision, Estimate, Metric, Optimum, Rig, StopReason, Uncertainty, Verdict
from coec.config import CameraIntrinsics
from coec.geometry import se3
from coec.geometry.cameras import build
from coec.io.exported_extrinsic import ExportedExtrinsic, ExtrinsicOrigin

ESTIMATE_RIG = Rig(
    "front",
    build("pinhole", width=4, height=3, fx=2.0, fy=2.0, cx=1.5, cy=1.0),
    "camera",
    "lidar",
    se3.perturbation(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])),
    np.eye(4),
)


def estimate(window: int, decision: Decision = Decision.ACCEPTED) -> Estimate:
    """Every number drawn from the seed `window`, which is its stamp, too."""
    rng = np.random.default_rng(window)
    return Estimate(
        window_id=f"front-{window}",
        data_stamp_ns=window,
        pairs=3,
        optimum=Optimum(
            se3.perturbation(rng.normal(size=6)),
            score=float(rng.normal()),
            score_at_start=float(rng.normal()),
            mi=float(rng.normal()),
            overlap=float(rng.normal()),
            points_in_view=5,
            evaluations=6,
            stop_reason=StopReason.TOLERANCE,
            first_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
            second_derivative=np.append(rng.normal(size=3), 3 * [np.nan]),
        ),
        verdict=Verdict(decision, (Metric("mi", 1 / 3, 0.1, True),), ()),
        correction=rng.normal(size=6),
        uncertainty=Uncertainty.unknown(),
        solved=np.arange(6) < 3,
        unobservable=np.zeros(6, np.bool_),
        compensation={"done": 3},
        depth_identity="precomputed",
        config_hash="c" * 16,
    )


def a_baseline() -> Baseline:
    """Of a pair `front`, solved in three degrees of freedom."""
    nan = np.nan
    return Baseline(
        pair="front",
        T_camera_lidar=se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])),
        rotation=Accuracy(
            bias=np.array([0.004, -0.001, 1 / 3 * 0.01, nan, nan, nan]),
            bias_sigma=np.array([0.001, 0.001, 0.002, nan, nan, nan]),
            spread=np.array([0.002, 0.002, 0.004, nan, nan, nan]),
        ),
        pose=Accuracy(np.full(6, 0.001), np.full(6, 0.002), np.full(6, 0.003)),
        dof=3,
        limits={"min_edge_contrast": 6.5, "max_runner_up": 0.7},
        monitor=MonitorLimits(12.9, 11.5, 9.0, min_mi=1.1, max_f1=4.0),
        scene=SceneBaseline(
            gradient=np.random.default_rng(0).uniform(2, 9, (BLOCK_ROWS, BLOCK_COLUMNS)),
            bands=np.full(BANDS, 1234.5),
            sectors=np.full(SECTORS, 77.0),
            range_edges=5000.0,
        ),
        false_alarm_rate=0.01,
        windows=2,
        pairs=40,
        detected={"0.5 deg": 1.0},
        sensors={"camera_serial": "C1"},
        depth_identity="sha",
        config_hash="hash",
    )


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
