"""A commissioned rig that does not exist."""

import numpy as np

from coec.calibration.commissioning.baseline import Accuracy, Baseline, MonitorLimits
from coec.calibration.monitor.sensor_faults import BANDS, BLOCK_COLUMNS, BLOCK_ROWS, SECTORS, SceneBaseline
from coec.geometry import se3


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
