"""What commissioned vehicles of a model tell of one that is not: nothing narrower than what they show themselves."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.baseline import MIN_VEHICLES, Accuracy, Baseline, for_rig, model_baseline, uncommissioned
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.io.rig_files import baseline_hash
from support.estimates import a_baseline
from support.scenes import BOARD_LENSES, board_rig

AMONG = np.array([0.003, 0.002, 0.004, 0.01, 0.02, 0.03])
"""How biases of vehicles differ, rad and m."""

RIG = board_rig(BOARD_LENSES["pinhole"])

COMMON = np.array([0.001, -0.002, 0.0, 0.01, 0.0, -0.02])


def _vehicle(rng: np.random.Generator) -> Baseline:
    pattern = a_baseline()
    bias = COMMON + AMONG * rng.standard_normal(6)
    turned = np.where(np.arange(6) < 3, bias, np.nan)
    return replace(
        pattern,
        T_camera_lidar=se3.perturb(pattern.T_camera_lidar, 0.01 * rng.standard_normal(6)),
        rotation=replace(pattern.rotation, bias=turned),
        pose=replace(pattern.pose, bias=bias),
        limits={"min_edge_contrast": float(rng.uniform(4, 8)), "max_runner_up": float(rng.uniform(0.5, 0.9))},
        monitor=replace(pattern.monitor, max_distance2_rotation=float(rng.uniform(9, 16)), min_overlap=0.4),
        sensors={"camera_serial": str(rng.integers(1000)), "camera_frame": "front"},
    )


@pytest.fixture
def vehicles() -> list[Baseline]:
    rng = np.random.default_rng(7)
    return [_vehicle(rng) for _ in range(5)]


def test_the_order_of_the_vehicles_changes_nothing(vehicles: list[Baseline]) -> None:
    made = {
        baseline_hash(model_baseline(order)) for order in itertools.islice(itertools.permutations(vehicles), 0, 120, 17)
    }
    assert len(made) == 1


def test_a_limit_refuses_no_more_than_that_of_any_vehicle(vehicles: list[Baseline]) -> None:
    model = model_baseline(vehicles)
    assert model.limits["min_edge_contrast"] == min(one.limits["min_edge_contrast"] for one in vehicles)
    assert model.limits["max_runner_up"] == max(one.limits["max_runner_up"] for one in vehicles)
    assert model.monitor.max_distance2_rotation == max(one.monitor.max_distance2_rotation for one in vehicles)
    assert model.monitor.min_overlap == 0.4


def test_a_limit_that_a_vehicle_did_not_learn_stays_as_configured(vehicles: list[Baseline]) -> None:
    without = replace(vehicles[0], limits={"max_runner_up": 0.7})
    assert set(model_baseline([without, *vehicles[1:]]).limits) == {"max_runner_up"}


def test_only_what_all_sensors_share_names_them(vehicles: list[Baseline]) -> None:
    assert model_baseline(vehicles).sensors == {"camera_frame": "front"}


@pytest.mark.parametrize("count", [MIN_VEHICLES, 8, 30])
def test_the_bias_of_a_further_vehicle_lies_where_the_model_says(count: int) -> None:
    """Standard errors over many models that were drawn have the spread of Student's t, whose tails few vehicles make
    wide: the share within two is that of the distribution."""
    rng = np.random.default_rng(count)
    separation = []
    for _ in range(200):
        model = model_baseline([_vehicle(rng) for _ in range(count)])
        separation.append((_vehicle(rng).pose.bias - model.pose.bias) / model.pose.bias_sigma)
    within = float(np.mean(np.abs(np.array(separation)) < 2.0))
    assert within == pytest.approx({3: 0.816, 8: 0.914, 30: 0.945}[count], abs=0.03)


def test_a_vehicle_is_measured_from_its_own_workshop_calibration_and_known_no_better_than_by_its_camera(
    vehicles: list[Baseline],
) -> None:
    alike = [replace(vehicles[0], pose=replace(one.pose, bias=COMMON)) for one in vehicles]
    taken = for_rig(model_baseline(alike), RIG)
    np.testing.assert_array_equal(taken.T_camera_lidar, RIG.T_camera_lidar_nominal)
    np.testing.assert_allclose(taken.pose.bias, COMMON)
    _, of_camera = uncommissioned(RIG.camera)
    np.testing.assert_array_equal(taken.pose.bias_sigma, of_camera.bias_sigma)


def test_vehicles_that_differ_much_make_it_wider(vehicles: list[Baseline]) -> None:
    far = [
        replace(one, pose=Accuracy(one.pose.bias + 0.1 * number, one.pose.bias_sigma, one.pose.spread))
        for number, one in enumerate(vehicles)
    ]
    taken = for_rig(model_baseline(far), RIG)
    assert (taken.pose.bias_sigma > 0.1).all()
    assert np.isnan(taken.rotation.bias_sigma[3:]).all()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"pair": "rear"}, "more than one pair: front, rear"),
        ({"dof": 6}, "more than one number of degrees of freedom"),
        ({"depth_identity": "another"}, "more than one depth network"),
        ({"config_hash": "another"}, "more than one configuration"),
    ],
)
def test_what_does_not_belong_together_is_refused(
    vehicles: list[Baseline], changed: dict[str, object], says: str
) -> None:
    other = replace(vehicles[0], **changed)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match=says):
        model_baseline([other, *vehicles[1:]])


def test_two_vehicles_do_not_show_how_they_differ(vehicles: list[Baseline]) -> None:
    with pytest.raises(CalibrationError, match="at least 3 vehicles"):
        model_baseline(vehicles[:2])
