"""Health reports the lens of the latest window against the configured one, accepted or not; nothing applies it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.state import PairRules, PairState, after_estimate, initial_state
from coec.calibration.types import Decision, LensEstimate
from coec.config import IDENTITY, CameraConfig, LidarConfig, MonitorConfig, PairConfig, PolicyConfig, TrackerConfig
from coec.io.rig_files import intrinsics_config
from coec.io.serialise import result_of
from coec.reports import replies as shown
from coec.schemas.message import to_json
from coec.schemas.replies import HealthReply
from coec.service.api.reply_builders import extrinsic_of, health_of
from coec.service.engine.messages import PairSnapshot
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.records.pair_store import ServedExtrinsic
from support.estimates import ESTIMATE_RIG, estimate

RULES = PairRules(PolicyConfig(apply="always"), TrackerConfig(), MonitorConfig())
PAIR = PairConfig(
    name="front",
    camera=CameraConfig(key="c", intrinsics=intrinsics_config(ESTIMATE_RIG.camera)),
    lidar=LidarConfig(key="l"),
    T_camera_lidar=IDENTITY,
)
LENS = LensEstimate(
    difference=np.array([0.5, -0.25, 0.01, 0.125]),
    sigma=np.array([0.1, 0.2, 0.003, 0.4]),
    free_difference=np.zeros(4),
    free_sigma=np.ones(4),
    determined=np.ones(4, np.bool_),
    probability=0.75,
)


def health(state: PairState) -> HealthReply:
    served = ServedExtrinsic(0, state.T_camera_lidar)
    known = PairSnapshot(state, served, None, (), None, None, 0, None, None, 0, 1, ())
    return health_of(known, StreamStatistics(), {}, (), (), PAIR, ESTIMATE_RIG, "v7")


@pytest.mark.parametrize("decision", list(Decision))
def test_health_has_the_drift_of_the_lens_of_the_latest_window(
    decision: Decision, capsys: pytest.CaptureFixture[str]
) -> None:
    state = after_estimate(initial_state(ESTIMATE_RIG), replace(estimate(7, decision), lens=LENS), 0, RULES)
    reply = health(state)
    drift = reply.intrinsics
    assert drift is not None
    assert (drift.window_id, drift.data_stamp_ns) == ("front-7", 7)
    assert (drift.focal_length.difference, drift.focal_length.sigma) == (0.01, 0.003)
    assert (drift.principal_point_x.difference, drift.principal_point_y.sigma) == (0.5, 0.2)
    assert drift.estimated == {"fx": 2.02, "fy": 2.02, "cx": 2.0, "cy": 0.75}
    shown.health(to_json(reply))
    assert "lens from configured: focal length +1.00 ± 0.30 %" in capsys.readouterr().out


def test_the_served_extrinsic_has_the_configured_intrinsics_whatever_a_window_says() -> None:
    solved = replace(estimate(7), lens=LENS)
    state = after_estimate(initial_state(ESTIMATE_RIG), solved, 0, RULES)
    reply = extrinsic_of("v7", ESTIMATE_RIG, state, result_of(solved, ESTIMATE_RIG, "v7"), 0.0, "hash")
    assert reply.intrinsics is not None
    assert reply.intrinsics.parameters == {"fx": 2.0, "fy": 2.0, "cx": 1.5, "cy": 1.0}
    nominal = extrinsic_of("v7", ESTIMATE_RIG, initial_state(ESTIMATE_RIG), None, 0.0, "hash")
    assert nominal.intrinsics == reply.intrinsics
    assert reply.intrinsics.sha256 is not None


def test_without_the_lens_of_a_window_there_is_no_drift() -> None:
    assert health(initial_state(ESTIMATE_RIG)).intrinsics is None
    assert health(after_estimate(initial_state(ESTIMATE_RIG), estimate(7), 0, RULES)).intrinsics is None
