"""The rig's joint estimate: better than its pairs, honest about it, and not bent by one that is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.rig.graph import Edge, RigGraph, RigidLink, Sensor
from coec.calibration.rig.joint_estimate import estimate_jointly
from coec.calibration.types import Uncertainty
from coec.geometry import se3
from support.rigs import POSES, SIGMA, TURN, edge_windows, graph, moved_poses

LOOPED = [(camera, lidar) for camera in ("front", "left", "rear") for lidar in ("roof", "bumper")]
EXACT = np.full(6, 1e-5)


def _truth(edge: Edge) -> np.ndarray:
    return np.asarray(POSES[edge.a] @ se3.inverse(POSES[edge.b]))


def test_exact_windows_give_the_truth_from_far_away() -> None:
    built = moved_poses("front", "roof", xi=np.array([0.05, -0.03, 0.04, 0.1, -0.05, 0.02]))
    rig = graph(LOOPED, poses=built)
    result = estimate_jointly(rig, edge_windows(graph(LOOPED), POSES, 1, sigma=1e-6 * np.ones(6)))
    for edge in rig.edges:
        np.testing.assert_allclose(result.T_a_b[edge.name], _truth(edge), atol=2e-5)
    assert result.freedom == 12
    assert result.consistent


def test_the_rig_knows_its_pairs_better_than_they_do_and_claims_what_it_knows() -> None:
    rig = graph(LOOPED)
    of_rig, of_pairs, claims = np.zeros(6), np.zeros(6), []
    for seed in range(15):
        reported = edge_windows(rig, POSES, seed)
        result = estimate_jointly(rig, reported)
        assert result.left_out is None
        for edge in rig.edges:
            error = se3.difference(result.T_a_b[edge.name], _truth(edge))
            of_rig += error**2
            of_pairs += se3.difference(reported[edge.name].T_camera_lidar, _truth(edge)) ** 2
            claims.append(error @ np.linalg.solve(result.between(edge.name, edge.name), error) / 6.0)
    assert np.sqrt(np.mean(of_rig / of_pairs)) < 0.9  # four sixths of the variance is left of six pairs of five sensors
    assert 0.7 < np.mean(claims) < 1.3


def test_covariances_of_two_pairs_are_those_of_many_rendered_rigs() -> None:
    rig, errors = graph(LOOPED[:4]), []
    for seed in range(60):
        result = estimate_jointly(rig, edge_windows(rig, POSES, seed))
        errors.append(np.concatenate([se3.difference(result.T_a_b[e.name], _truth(e)) for e in rig.edges]))
    rendered = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(result.covariance.diagonal(), result.covariance.diagonal()))
    assert np.abs((rendered - result.covariance) / scale).max() < 0.6  # 1/√60 is 0.13, of 576 entries
    assert np.abs(result.between("front-roof", "left-roof")).max() > 0.0


@pytest.mark.fault(
    "one pair's window is 1° off, and claims not to be", "it alone is left out; the rest is not distorted"
)
def test_one_bad_edge_is_detected_and_bends_nothing(record_property: Callable[[str, object], None]) -> None:
    rig = graph([*LOOPED, ("roof", "bumper")])
    reported = edge_windows(rig, POSES, 4)
    bad = replace(reported["roof-bumper"], T_camera_lidar=se3.perturb(reported["roof-bumper"].T_camera_lidar, TURN))
    result = estimate_jointly(rig, {**reported, "roof-bumper": bad})
    assert not result.consistent
    assert result.left_out == "roof-bumper"
    assert any("roof-bumper" in loop.names for loop in result.open_loops)
    worst = max(se3.rotation_angle_rad(result.T_a_b[e.name] @ se3.inverse(_truth(e))) for e in rig.edges)
    assert worst < radians(0.3)
    record_property("figure", f"{np.degrees(worst):.2f}° at most, of 1°")


def test_of_a_single_loop_nobody_knows_which_edge_is_wrong() -> None:
    rig = graph(LOOPED[:4])
    reported = edge_windows(rig, POSES, 4)
    bad = replace(reported["left-roof"], T_camera_lidar=se3.perturb(reported["left-roof"].T_camera_lidar, TURN))
    result = estimate_jointly(rig, {**reported, "left-roof": bad})
    assert not result.consistent
    assert result.left_out is None
    assert [set(loop.names) for loop in result.open_loops] == [set(rig.edge)]
    assert result.widened > 3.0


def test_without_a_loop_every_pair_keeps_its_own_result() -> None:
    rig = graph(LOOPED[::2])
    reported = edge_windows(rig, POSES, 2)
    result = estimate_jointly(rig, reported)
    assert result.freedom == 0
    assert result.chance == 1.0
    for name, window in reported.items():
        off = se3.difference(result.T_a_b[name], window.T_camera_lidar)
        assert np.abs(off / SIGMA).max() < 0.05  # what is known of the mounts hardly pulls
        np.testing.assert_allclose(np.sqrt(result.between(name, name).diagonal()), SIGMA, rtol=0.05)


def test_an_edge_that_nothing_measured_is_reported_by_the_others() -> None:
    rig = graph(LOOPED)
    reported = edge_windows(rig, POSES, 3)
    del reported["left-bumper"]
    result = estimate_jointly(rig, reported)
    sigma = np.sqrt(result.between("left-bumper", "left-bumper").diagonal())
    assert (sigma[:3] < radians(0.3)).all()
    assert np.abs(se3.difference(result.T_a_b["left-bumper"], _truth(rig.edge["left-bumper"]))[:3]).max() < radians(0.3)


def test_an_error_of_a_lens_is_common_to_the_pairs_of_its_camera() -> None:
    rig = graph([("front", "roof"), ("front", "bumper"), ("left", "roof")])
    shift = np.array([0.0, radians(0.1), 0.0, 0.0, 0.0, 0.0])
    reported = {
        name: replace(window, uncertainty=Uncertainty(np.diag(EXACT**2), {"lens_across": shift}, 9.0))
        for name, window in edge_windows(rig, POSES, 1, sigma=EXACT).items()
    }
    result = estimate_jointly(rig, reported)
    assert result.between("front-roof", "front-bumper")[1, 1] == pytest.approx(shift[1] ** 2, rel=0.01)
    assert abs(result.between("front-roof", "left-roof")[1, 1]) < 0.05 * shift[1] ** 2


def test_a_link_holds_what_the_windows_leave_open() -> None:
    known = RigidLink("bar", "front", "left", POSES["front"] @ se3.inverse(POSES["left"]), np.full(6, 1e-4))
    pairs = LOOPED[:4:2]
    reported = edge_windows(graph(pairs), POSES, 5)
    alone, linked = (estimate_jointly(graph(pairs, links), reported) for links in ((), (known,)))
    between = linked.T_a_b["front-roof"] @ se3.inverse(linked.T_a_b["left-roof"])
    np.testing.assert_allclose(se3.difference(between, known.T_a_b), 0.0, atol=5e-4)
    assert linked.freedom == 6
    assert (np.diagonal(linked.covariance) <= np.diagonal(alone.covariance) * 1.001).all()


def test_neither_names_nor_order_nor_the_frame_of_the_rig_matter() -> None:
    rig = graph(LOOPED)
    reported = edge_windows(rig, POSES, 6)
    other = {"front": "z", "left": "m", "rear": "a", "roof": "k", "bumper": "b"}
    twin = RigGraph.of(
        [Sensor(other[sensor.name], sensor.kind) for sensor in rig.sensors],
        [Edge(f"e{9 - place}", other[e.a], other[e.b], e.T_a_b) for place, e in enumerate(rig.edges)],
    )
    result = estimate_jointly(rig, reported)
    renamed = estimate_jointly(twin, {f"e{9 - place}": reported[edge.name] for place, edge in enumerate(rig.edges)})
    for place, edge in enumerate(rig.edges):
        np.testing.assert_allclose(renamed.T_a_b[f"e{9 - place}"], result.T_a_b[edge.name], atol=1e-9)
    assert renamed.chi2 == pytest.approx(result.chi2, rel=1e-6)


@pytest.mark.fault(
    "a window of a rig claims NaN, a singular covariance or an invalid pose", "it is refused with its reason"
)
def test_hostile_windows_are_refused() -> None:
    rig = graph(LOOPED[:2])
    reported = edge_windows(rig, POSES, 1)
    one = reported["front-roof"]
    hostile = [
        replace(one, T_camera_lidar=np.full((4, 4), np.nan)),
        replace(one, uncertainty=Uncertainty(np.ones((6, 6)), {}, 1.0)),
        replace(one, uncertainty=Uncertainty(np.diag(SIGMA**2), {"lens_down": np.full(6, np.inf)}, 1.0)),
        replace(one, uncertainty=Uncertainty(np.diag(np.full(6, 1e-40)), {}, 1.0)),
    ]
    for window in hostile:
        with pytest.raises(ValueError, match="front-roof"):
            estimate_jointly(rig, {**reported, "front-roof": window})
    with pytest.raises(ValueError, match="not an edge of this rig"):
        estimate_jointly(rig, {"other": one})
    with pytest.raises(ValueError, match="no window constrains"):
        estimate_jointly(rig, {"front-roof": replace(one, uncertainty=Uncertainty.unknown())})
