"""What was known before a sensor moved: its pairs tell one move together, and what stood still is not measured anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.rig.graph import RigGraph, RigidLink, was
from coec.calibration.rig.joint_estimate import CREEP, SHAKEN, PreMoveKnowledge, estimate_jointly, remembered
from coec.calibration.tracker import NS_PER_H, Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry import se3
from support.rigs import NS, POSES, SIGMA, TURN, edge_windows, graph, moved_poses

CAMERAS = ("front", "left", "rear")
STAR = graph([(camera, "roof") for camera in CAMERAS])
EXACT, NOTHING = np.full(6, 1e-5), np.full(6, 5.0)
KNOCK = np.array([0.01, -0.015, 0.008, 0.02, -0.01, 0.03])
AFTER = moved_poses("roof", xi=KNOCK)
Poses = Mapping[str, Matrix4]


def known(rig: RigGraph, seed: int, sigma: np.ndarray, sensors: tuple[str, ...] = ("roof",)) -> PreMoveKnowledge:
    """What windows of before the knock say of the pairs of these sensors."""
    reported = edge_windows(rig, POSES, seed, sigma)
    return PreMoveKnowledge(sensors, {e.name: reported[e.name] for e in rig.edges if {e.a, e.b} & set(sensors)})


def truth(rig: RigGraph, name: str, poses: Poses) -> Matrix4:
    edge = rig.edge[name]
    return np.asarray(poses[edge.a] @ se3.inverse(poses[edge.b]))


def move_of(result: Matrix4, before: Matrix4) -> Matrix4:
    """Of the LiDAR, about its own axes as they were, as a pair tells it."""
    return np.asarray(se3.inverse(before) @ result)


def test_with_exact_knowledge_all_pairs_share_one_move_of_the_lidar() -> None:
    result = estimate_jointly(STAR, edge_windows(STAR, AFTER, 1), known(STAR, 2, EXACT))
    reported = [move_of(result.T_a_b[edge.name], truth(STAR, edge.name, POSES)) for edge in STAR.edges]
    for other in reported[1:]:
        np.testing.assert_allclose(se3.difference(other, reported[0]), 0.0, atol=1e-4)
    assert result.freedom == 12
    assert result.consistent
    assert set(result.T_a_b) == set(STAR.edge)
    assert result.measured == tuple(STAR.edge)


def test_with_no_knowledge_every_pair_keeps_its_own_result() -> None:
    reported = edge_windows(STAR, AFTER, 1)
    alone, result = estimate_jointly(STAR, reported), estimate_jointly(STAR, reported, known(STAR, 2, NOTHING))
    for name in STAR.edge:
        np.testing.assert_allclose(se3.difference(result.T_a_b[name], alone.T_a_b[name]) / SIGMA, 0.0, atol=0.02)
        np.testing.assert_allclose(result.between(name, name), alone.between(name, name), atol=0.02 * SIGMA.max() ** 2)


def test_what_was_known_halves_the_error_and_no_more_is_claimed() -> None:
    of_rig, of_pairs, claims = np.zeros(6), np.zeros(6), []
    for seed in range(25):
        reported = edge_windows(STAR, AFTER, seed)
        result = estimate_jointly(STAR, reported, known(STAR, 1000 + seed, 0.3 * SIGMA))
        for name in STAR.edge:
            error = se3.difference(result.T_a_b[name], truth(STAR, name, AFTER))
            of_rig += error**2
            of_pairs += se3.difference(reported[name].T_camera_lidar, truth(STAR, name, AFTER)) ** 2
            claims.append(error @ np.linalg.solve(result.between(name, name), error) / 6.0)
    assert np.sqrt(np.mean(of_rig / of_pairs)) < 0.7  # 0.58 of one move by three windows, and what was not known before
    assert 0.7 < np.mean(claims) < 1.3


def test_neither_the_order_of_the_pairs_nor_the_frame_of_the_lidar_matters() -> None:
    reported, before = edge_windows(STAR, AFTER, 3), known(STAR, 4, 0.5 * SIGMA)
    result = estimate_jointly(STAR, reported, before)
    shuffled = RigGraph.of(STAR.sensors[::-1], STAR.edges[::-1])
    backwards = replace(before, edges=dict(reversed(list(before.edges.items()))))
    again = estimate_jointly(shuffled, dict(reversed(list(reported.items()))), backwards)
    frame = se3.exp(np.array([0.3, -0.8, 1.1, 2.0, -1.0, 0.5]))

    def turned(one: Measurement) -> Measurement:
        return replace(one, T_camera_lidar=one.T_camera_lidar @ frame)

    edges = [replace(edge, T_a_b=edge.T_a_b @ frame) for edge in STAR.edges]
    other = estimate_jointly(
        RigGraph.of(STAR.sensors, edges),
        {name: turned(one) for name, one in reported.items()},
        replace(before, edges={name: turned(one) for name, one in before.edges.items()}),
    )
    for name in STAR.edge:
        np.testing.assert_array_equal(again.T_a_b[name], result.T_a_b[name])
        off = se3.difference(other.T_a_b[name], result.T_a_b[name] @ frame)
        np.testing.assert_allclose(off / SIGMA, 0.0, atol=0.02)  # what is known of the mounts hardly pulls
    assert other.chi2 == pytest.approx(result.chi2, rel=0.02)


def test_a_camera_that_moved_leaves_the_others_where_they_were() -> None:
    reported = edge_windows(STAR, moved_poses("front"), 5)
    alone, result = (
        estimate_jointly(STAR, reported),
        estimate_jointly(STAR, reported, known(STAR, 6, EXACT, ("front",))),
    )
    for name in STAR.edge:
        np.testing.assert_allclose(se3.difference(result.T_a_b[name], alone.T_a_b[name]) / SIGMA, 0.0, atol=0.02)
    assert result.freedom == 0


@pytest.mark.fault(
    "a camera is moved by the same knock as its LiDAR", "earlier knowledge of it is dropped; it keeps its own window"
)
def test_what_a_camera_denies_of_the_past_is_left_out_and_bends_nothing(
    record_property: Callable[[str, object], None],
) -> None:
    after = {**AFTER, "left": moved_poses("left")["left"]}
    reported = edge_windows(STAR, after, 7)
    result = estimate_jointly(STAR, reported, known(STAR, 8, 0.3 * SIGMA))
    assert not result.consistent
    assert result.left_out == "left-roof"
    assert any(was("left-roof") in loop.names for loop in result.open_loops)
    own = se3.difference(result.T_a_b["left-roof"], reported["left-roof"].T_camera_lidar)
    assert np.abs(own / SIGMA).max() < 2.0
    worst = max(np.abs(se3.difference(result.T_a_b[e], truth(STAR, e, after)))[:3].max() for e in STAR.edge)
    assert worst < radians(0.2)
    record_property("figure", f"{np.degrees(worst):.2f}° at most, of 1°")


def test_of_two_pairs_that_report_different_moves_nobody_knows_which_is_right() -> None:
    rig = graph([(camera, "roof") for camera in CAMERAS[:2]])
    reported = edge_windows(rig, {**AFTER, "left": moved_poses("left")["left"]}, 7)
    result = estimate_jointly(rig, reported, known(rig, 8, 0.3 * SIGMA))
    assert not result.consistent
    assert result.left_out is None
    assert result.widened > 3.0


def test_a_bad_window_is_distinguished_from_what_was_known_before_where_another_lidar_speaks() -> None:
    rig = graph([(camera, lidar) for camera in CAMERAS for lidar in ("roof", "bumper")])
    reported = edge_windows(rig, AFTER, 9)
    bad = replace(reported["left-roof"], T_camera_lidar=se3.perturb(reported["left-roof"].T_camera_lidar, TURN))
    result = estimate_jointly(rig, {**reported, "left-roof": bad}, known(rig, 10, 0.3 * SIGMA))
    assert result.left_out == "left-roof"
    away = se3.difference(result.T_a_b["left-roof"], truth(rig, "left-roof", AFTER))
    assert np.abs(away[:3]).max() < radians(0.2), "the others say where it is"


def test_a_bar_holds_before_as_it_does_after() -> None:
    bar = RigidLink("bar", "front", "left", POSES["front"] @ se3.inverse(POSES["left"]), np.full(6, 1e-4))
    rig = graph([(camera, "roof") for camera in CAMERAS], [bar])
    joined = PreMoveKnowledge(("front", "left"), known(rig, 1, SIGMA, ("front", "left")).edges).joined(rig)
    assert {link.name: (link.a, link.b) for link in joined.links} == {
        "bar": ("front", "left"),
        was("bar"): (was("front"), was("left")),
    }
    assert {sensor.name for sensor in joined.sensors} == {*rig.place, was("front"), was("left")}
    assert (joined.edge[was("front-roof")].a, joined.edge[was("front-roof")].b) == (was("front"), "roof")


def test_what_was_known_is_less_sure_after_a_while_and_scenes_are_no_more_in_common() -> None:
    lens, scene = 1e-3 * np.eye(6)[1], 2e-3 * np.eye(6)[0]
    one = Measurement(POSES["front"], Uncertainty(np.diag(SIGMA**2), {"lens_across": lens, "columns": scene}, 3.0), NS)
    old = remembered(one, NS + 4 * NS_PER_H)
    added = SIGMA**2 + SHAKEN**2 + 4.0 * CREEP**2
    np.testing.assert_allclose(old.uncertainty.noise, np.diag(added) + np.outer(scene, scene), rtol=1e-12)
    assert list(old.uncertainty.systematic) == ["lens_across"]
    assert old.determined_axes() == list(range(6))
    np.testing.assert_array_equal(remembered(one, 0).uncertainty.noise, remembered(one, NS).uncertainty.noise)
