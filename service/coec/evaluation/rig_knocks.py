"""How well the pairs of a LiDAR are known right after it was knocked, from one window of each pair and from what was
known before. The windows are drawn (`rig_evidence`)."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.before import SHAKEN, PreMoveKnowledge
from coec.calibration.rig.joint import JointEstimate, estimate_jointly
from coec.calibration.tracker import Measurement, Track, prior_sigma, update_track
from coec.calibration.types import Matrix4
from coec.config import TrackerConfig
from coec.evaluation.rig_evidence import BUILT, NS_PER_S, Lasting, Poses, SimulatedRig, moved, off, windows
from coec.geometry import se3
from coec.schemas.replies import Vector6
from coec.schemas.rig import KnockedRow

DISPLACED_SEED = 18_300_002
"""Any number from which nothing was learned."""

LIDAR = "roof"
"""The LiDAR that is knocked."""

KNOCK_RAD = radians(1.0)
ALSO_RAD = radians(0.5)
"""Turn of one of its cameras in a second run, to see whether the extra move is noticed."""

WINDOWS, SLICE_NS = 6, 180 * NS_PER_S
"""Windows of each pair before the knock, and the time from one to the next: a quarter of an hour of driving."""


def displaced_lidar_row(rig: SimulatedRig, rigs: int) -> KnockedRow:
    """Figures over `rigs` drawn rigs. Mounts that are not knocked are shaken by as much as `before` assumes."""
    of_rig, of_windows, of_pairs = np.zeros(6), np.zeros(6), np.zeros(6)
    nees: list[float] = []
    worst: list[tuple[float, float]] = []
    consistent = also = 0
    for number in range(rigs):
        rng = np.random.default_rng([DISPLACED_SEED, number, *rig.name.encode()])
        lasting, right = Lasting.of(rig, rng), off(rig.poses, BUILT, rng)
        before = _known(rig, right, lasting, rng)
        shaken = off(right, SHAKEN / np.sqrt(2.0), rng)  # both sensors of an edge together: `SHAKEN`
        after = moved(shaken, (LIDAR,), KNOCK_RAD, rng)
        measurements = _windows(rig, after, lasting, rng)
        with_before, without = (
            estimate_jointly(rig.graph, measurements, before),
            estimate_jointly(rig.graph, measurements),
        )
        consistent += with_before.consistent
        each = []
        for edge in rig.graph.edges:
            truth = after[edge.a] @ se3.inverse(after[edge.b])
            error, of_pair = (
                _error(with_before, edge.name, truth),
                se3.difference(measurements[edge.name].T_camera_lidar, truth),
            )
            of_rig, of_pairs = of_rig + error**2, of_pairs + of_pair**2
            of_windows = of_windows + _error(without, edge.name, truth) ** 2
            nees.append(float(error @ np.linalg.solve(with_before.between(edge.name, edge.name), error)) / 6.0)
            each.append((float(np.linalg.norm(error[:3])), float(np.linalg.norm(of_pair[:3]))))
        worst.append((max(one for one, _ in each), max(other for _, other in each)))
        turned = rig.graph.edges[0].a
        also += estimate_jointly(
            rig.graph, _windows(rig, moved(after, (turned,), ALSO_RAD, rng), lasting, rng), before
        ).consistent  # fmt: skip
    ratio = np.sqrt(of_rig / of_pairs)
    rx, ry, rz, tx, ty, tz = ratio.tolist()
    axes: Vector6 = (rx, ry, rz, tx, ty, tz)
    return KnockedRow(
        rig=rig.name, rigs=rigs, pairs=len(rig.graph.edges), rms_ratio=axes,
        rms_ratio_all=float(np.sqrt(np.mean(ratio**2))),
        rms_ratio_without=float(np.sqrt(np.mean(of_windows / of_pairs))), nees=float(np.mean(nees)),
        worst_deg=degrees(max(one for one, _ in worst)), worst_of_pairs_deg=degrees(max(other for _, other in worst)),
        consistent=consistent, also_missed=also,
    )  # fmt: skip


def _error(joint: JointEstimate, edge: str, truth: Matrix4) -> NDArray[np.float64]:
    return se3.difference(joint.T_a_b[edge], truth)


def _known(rig: SimulatedRig, poses: Poses, lasting: Lasting, rng: np.random.Generator) -> PreMoveKnowledge:
    """What the tracks of all windows before the knock say about the pairs of the LiDAR."""
    config, tracks = TrackerConfig(), dict[str, Track]()
    for number in range(WINDOWS):
        for name, window in windows(rig, poses, lasting, rng).items():
            track = tracks.get(name) or Track.initial(window.T_camera_lidar, prior_sigma(config))
            tracks[name] = update_track(track, replace(window, stamp_ns=number * SLICE_NS), config)
    pairs = [edge.name for edge in rig.graph.edges if LIDAR in (edge.a, edge.b)]
    known = {
        name: (Measurement(tracks[name].T_camera_lidar, tracks[name].uncertainty, tracks[name].stamp_ns),)
        for name in pairs
        if name not in rig.graph.of_lidars
    }
    at_ns = WINDOWS * SLICE_NS
    return PreMoveKnowledge.of((LIDAR,), known, at_ns, at_ns)


def _windows(rig: SimulatedRig, poses: Poses, lasting: Lasting, rng: np.random.Generator) -> dict[str, Measurement]:
    """One window of each edge after the knock."""
    measurements = windows(rig, poses, lasting, rng)
    return {name: replace(one, stamp_ns=(WINDOWS + 1) * SLICE_NS) for name, one in measurements.items()}
