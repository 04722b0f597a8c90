"""The marginal likelihoods of who moved, against plain sampling of the same model."""

from __future__ import annotations

from math import log, pi

import numpy as np
import pytest

from coec.calibration.baseline import normal_quantile
from coec.calibration.rig.edge_observations import EdgeSteps
from coec.calibration.rig.moved_sensors import M_PER_RAD, SCALES, movers, patterns, who_moved
from coec.calibration.types import MOUNT_RAD
from coec.geometry import se3
from support.rigs import POSES, graph

STAR = (("front", "roof"), ("left", "roof"), ("rear", "roof"))
COARSE = np.diag(np.array([0.008] * 3 + [0.05] * 3) ** 2)
"""Noise about as wide as moves are: so draws of these hit what was seen often enough to integrate by them."""
DRAWS = 60_000


def _log_normal(away: np.ndarray) -> np.ndarray:
    inverse = np.linalg.inv(COARSE)
    q = np.einsum("...i,ij,...j->...", away, inverse, away)
    return np.asarray(-0.5 * (q + np.linalg.slogdet(COARSE)[1] + 6.0 * log(2.0 * pi)))


def test_sets_are_as_likely_against_each_other_as_sampling_says() -> None:
    rig = graph(STAR)
    rng = np.random.default_rng(5)
    moving = movers(rig)
    design = patterns(rig, moving)
    true = np.array([0.02, -0.015, 0.01, 0.05, 0.0, -0.05])
    roof = [mover.sensors for mover in moving].index(("roof",))
    seen = design[roof] @ true + rng.multivariate_normal(np.zeros(6), 0.1 * COARSE, size=len(rig.edges))
    steps = {
        edge.name: EdgeSteps(
            xi=seen[place][None],
            covariance=COARSE[None],
            observations=np.ones(1),
            log_transient=np.array([-700.0]),
            log_stepped=np.zeros(1),
            log_still=float(_log_normal(seen[place])),
        )
        for place, edge in enumerate(rig.edges)
    }
    result = who_moved(rig, steps)
    scales = [MOUNT_RAD / normal_quantile(0.5 + 0.5 * (k + 0.5) / SCALES) for k in range(SCALES)]
    sampled = {}
    for number, mover in enumerate(moving):
        likelihoods = []
        for scale in scales:
            sigma = np.array([scale] * 3 + [scale * M_PER_RAD] * 3)
            x = sigma * rng.normal(size=(DRAWS, 6))
            away = seen - np.einsum("eij,nj->nei", design[number], x)
            likelihoods.append(np.exp(_log_normal(away).sum(axis=1)).mean())
        sampled[mover.sensors] = float(np.mean(likelihoods))
    reported = {sensors: p for sensors, p in result.sets if len(sensors) == 1}
    best = max(reported, key=lambda sensors: reported[sensors])
    assert best == ("roof",)
    for sensors, p in reported.items():
        assert log(p / reported[best]) == pytest.approx(log(sampled[sensors] / sampled[best]), abs=0.15)


def test_patterns_are_how_poses_step_as_sensors_move() -> None:
    rig = graph(STAR)
    xi = 1e-6 * np.array([1.0, -2.0, 3.0, 2.0, 1.0, -1.0])
    for mover, design in zip(movers(rig), patterns(rig, movers(rig)), strict=True):
        after = {name: se3.perturb(pose, xi) if name in mover.sensors else pose for name, pose in POSES.items()}
        for edge, of in zip(rig.edges, design, strict=True):
            stepped = se3.difference(after[edge.a] @ se3.inverse(after[edge.b]), edge.T_a_b)
            np.testing.assert_allclose(of @ xi, stepped, atol=1e-10)


def test_edges_that_nobody_checked_since_speak_neither_for_nor_against_a_sensor() -> None:
    """An edge between two LiDARs stepped after the last look at any camera. The one has three of these, the other one:
    that makes neither likelier."""
    rig = graph([*STAR, ("front", "bumper"), ("roof", "bumper")])
    rounds, step = np.tile(COARSE, (2, 1, 1)), np.tile([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], (2, 1))
    likely = float(_log_normal(np.zeros(6)))
    still = EdgeSteps(np.zeros((2, 6)), rounds, np.array([0.0, 3.0]), np.array([0.0, -700.0]), np.zeros(2), likely)
    seen = EdgeSteps(step, rounds, np.ones(2), np.full(2, -700.0), np.zeros(2), float(_log_normal(step[0])))
    result = who_moved(rig, {edge.name: seen if edge.name == "roof-bumper" else still for edge in rig.edges})
    assert log(result.sensors["roof"] / result.sensors["bumper"]) == pytest.approx(0.0, abs=1.0)
    assert result.sensors["roof"] + result.sensors["bumper"] > 0.8
    assert result.when == 0
