"""Drawn evidence of a rig is as it is stated to be."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.rig import edge_observations
from coec.geometry import se3
from coec_lab.experiments.rig_evidence import (
    FULL,
    LIDAR_CHECK,
    LIDAR_LATE_S,
    LIDAR_PERIOD_S,
    NS_PER_S,
    UNLINKED,
    Happening,
    Lasting,
    TimedEvidence,
    simulate_checks,
    windows,
)

STILL = Happening(FULL.poses, FULL.poses, None, 0.0, 1500.0)


def scattered(received: list[TimedEvidence], name: str) -> NDArray[np.float64]:
    """(N, 6) of the looks at an edge, about their middle: its bias is drawn once."""
    edge = FULL.graph.edge[name]
    offsets = np.array(
        [se3.difference(observation.T_a_b, edge.T_a_b) for _, observation in received if observation.edge == name]
    )
    return np.asarray(offsets - np.median(offsets, axis=0))


def test_observations_of_two_lidars_come_in_their_time_and_scatter_as_those_on_streets() -> None:
    received = simulate_checks(FULL, STILL, np.random.default_rng(4))
    assert received == sorted(received, key=lambda one: one[0])
    of_lidars = [(at_s, observation) for at_s, observation in received if observation.edge in FULL.graph.of_lidars]
    assert all(at_s - observation.stamp_ns / NS_PER_S == pytest.approx(LIDAR_LATE_S) for at_s, observation in of_lidars)
    spaced = (
        np.diff([at_s for at_s, observation in of_lidars if observation.edge == "roof-short_left"]) / LIDAR_PERIOD_S
    )
    np.testing.assert_allclose(spaced, np.round(spaced))
    offsets = np.concatenate([scattered(received, name) for name in sorted(FULL.graph.of_lidars)])
    middle = np.median(np.abs(offsets), axis=0) / 0.6745  # of a normal variable, its standard deviation
    expected = np.hypot(LIDAR_CHECK, edge_observations.PLACE)
    assert ((middle > 0.6 * expected) & (middle < 1.5 * expected)).all()
    assert np.abs(offsets).max() > 20.0 * expected.max(), "some are bad"


def test_a_rig_whose_lidars_are_not_checked_has_no_such_observations() -> None:
    assert not UNLINKED.graph.of_lidars
    seen = Counter(observation.edge for _, observation in simulate_checks(UNLINKED, STILL, np.random.default_rng(4)))
    assert set(seen) <= set(UNLINKED.graph.edge)


def test_what_lasts_is_in_every_window_of_a_rig() -> None:
    rng = np.random.default_rng(5)
    lasting = Lasting.of(FULL, rng)
    offsets = []
    for _ in range(60):
        reported = windows(FULL, FULL.poses, lasting, rng)
        offsets.append([se3.difference(reported[n].T_camera_lidar, FULL.graph.edge[n].T_a_b) for n in lasting.between])
    mean = np.mean(offsets, axis=0)
    for place, name in enumerate(lasting.between):
        np.testing.assert_allclose(mean[place], lasting.between[name], atol=5.0 * LIDAR_CHECK.max() / np.sqrt(60.0))
