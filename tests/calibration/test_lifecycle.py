"""What is served: never an estimate that was not accepted, never health that was not looked at."""

from dataclasses import replace

import numpy as np
import pytest

from coec.adapters.images import GreyImages
from coec.calibration.calibrator import calibrate
from coec.calibration.lifecycle import (
    HealthState,
    Provenance,
    Status,
    after_estimate,
    after_failure,
    assess,
    initial_state,
    restored,
)
from coec.calibration.ports import DepthModel, Silence
from coec.calibration.values import Decision, Estimate, Reason, Window
from coec.config import CalibrationConfig, LimitsConfig

DAY_S = 86_400.0
CRASH = Reason("worker_failed", "The worker crashed twice.")


@pytest.fixture(scope="module")
def accepted(street: Window, stereo: DepthModel) -> Estimate:
    return calibrate(street, stereo, GreyImages(LimitsConfig()), CalibrationConfig(), Silence())


@pytest.fixture(scope="module")
def failed(accepted: Estimate) -> Estimate:
    verdict = replace(accepted.verdict, decision=Decision.FAILED, reasons=(Reason("overlap", "too little"),))
    moved = accepted.optimum.T_camera_lidar @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(accepted, verdict=verdict, optimum=replace(accepted.optimum, T_camera_lidar=moved))


def test_before_anything_the_nominal_extrinsic_is_served_and_health_is_unknown(street: Window) -> None:
    state = initial_state(street.rig)
    assert state.provenance is Provenance.NOMINAL
    assert state.status is Status.NOT_ACCEPTED
    np.testing.assert_array_equal(state.T_camera_lidar, street.rig.T_camera_lidar_nominal)
    assert assess(state, None, DAY_S).state is HealthState.UNKNOWN


def test_an_accepted_estimate_is_served(street: Window, accepted: Estimate) -> None:
    state = after_estimate(initial_state(street.rig), accepted)
    np.testing.assert_array_equal(state.T_camera_lidar, accepted.optimum.T_camera_lidar)
    assert (state.provenance, state.status) == (Provenance.ESTIMATED, Status.ACCEPTED)
    assert state.valid_from_ns == accepted.data_stamp_ns
    assert assess(state, 1.0, DAY_S).state is HealthState.HEALTHY


def test_a_failed_estimate_is_never_served(street: Window, accepted: Estimate, failed: Estimate) -> None:
    for before in (initial_state(street.rig), after_estimate(initial_state(street.rig), accepted)):
        state = after_estimate(before, failed)
        np.testing.assert_array_equal(state.T_camera_lidar, before.T_camera_lidar)
        assert state.provenance is before.provenance
        assert state.status is Status.FAILED
        health = assess(state, 1.0, DAY_S)
        assert health.state is HealthState.SUSPECT
        assert health.reasons == failed.verdict.reasons


def test_a_window_that_gave_no_estimate_degrades_and_serves_what_was(street: Window, accepted: Estimate) -> None:
    before = after_estimate(initial_state(street.rig), accepted)
    state = after_failure(before, CRASH)
    np.testing.assert_array_equal(state.T_camera_lidar, before.T_camera_lidar)
    assert assess(state, 1.0, DAY_S) == replace(assess(state, 1.0, DAY_S), state=HealthState.DEGRADED, reasons=(CRASH,))
    assert assess(after_estimate(state, accepted), 1.0, DAY_S).state is HealthState.HEALTHY


def test_an_old_result_is_stale_not_healthy(street: Window, accepted: Estimate) -> None:
    state = after_estimate(initial_state(street.rig), accepted)
    assert assess(state, DAY_S + 1.0, DAY_S).state is HealthState.STALE


def test_an_estimate_read_back_from_disk_says_so_and_its_age_is_unknown(street: Window, accepted: Estimate) -> None:
    state = restored(after_estimate(initial_state(street.rig), accepted))
    assert state.provenance is Provenance.RESTORED
    assert assess(state, None, DAY_S).state is HealthState.UNKNOWN
    assert restored(initial_state(street.rig)).provenance is Provenance.NOMINAL
