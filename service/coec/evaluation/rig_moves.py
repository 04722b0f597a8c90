"""Does a rig name the sensors that moved, and no others? Tried on drawn evidence (`rig_evidence`), drive after drive.
Also: how much better a rig knows its pairs than each pair alone does."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from coec.calibration.rig.attribution import (
    RigState,
    SensorHealth,
    after_edge_observation,
    after_window,
    initial,
    sensors,
    served,
)
from coec.calibration.rig.joint import estimate_jointly
from coec.evaluation.rig_evidence import (
    BUILT,
    FOUR,
    FULL,
    SINGLE,
    UNLINKED,
    Bend,
    Happening,
    Lasting,
    SimulatedRig,
    TimedEvidence,
    moved,
    off,
    simulate_checks,
    windows,
)
from coec.evaluation.rig_knocks import displaced_lidar_row
from coec.evaluation.rig_windows import urgent_evidence
from coec.geometry import se3
from coec.geometry.vectors import random_direction
from coec.schemas.replies import Vector6
from coec.schemas.rig import JointRow, MovesRow, RigMovesReport

AT_S, ALLOWED_S = 90.0, 60.0
"""About when sensors move, and how soon they must be named after that, s."""

STEP_RAD = radians(1.0)
SEED = 18_300_001
"""Any number from which nothing was learned."""

MOVED = frozenset({SensorHealth.CAMERA_MOVED, SensorHealth.LIDAR_MOVED})


@dataclass(frozen=True, slots=True)
class RigFault:
    """What happens on a drive: how many cameras and LiDARs turn by `angle_rad`, or that one pair is disturbed by it."""

    name: str
    cameras: int = 0
    lidars: int = 0
    pairs: int = 0
    angle_rad: float = STEP_RAD


NOBODY = RigFault("nobody")
FAULTS: tuple[tuple[SimulatedRig, RigFault], ...] = (
    (FOUR, NOBODY),
    (FOUR, RigFault("one camera 1°", cameras=1)),
    (FOUR, RigFault("the LiDAR 1°", lidars=1)),
    (FOUR, RigFault("two cameras 1°", cameras=2)),
    (FOUR, RigFault("one camera 0.5°", cameras=1, angle_rad=radians(0.5))),
    (FOUR, RigFault("the LiDAR 10°", lidars=1, angle_rad=radians(10.0))),
    (FULL, NOBODY),
    (FULL, RigFault("one camera 1°", cameras=1)),
    (FULL, RigFault("one LiDAR 1°", lidars=1)),
    (FULL, RigFault("two cameras 1°", cameras=2)),
    (FULL, RigFault("one pair disturbed by 1°", pairs=1)),
    (UNLINKED, NOBODY),
    (UNLINKED, RigFault("one camera 1°", cameras=1)),
    (UNLINKED, RigFault("one LiDAR 1°", lidars=1)),
    (UNLINKED, RigFault("two cameras 1°", cameras=2)),
    (SINGLE, RigFault("the LiDAR 1°", lidars=1)),
    (SINGLE, RigFault("the camera 1°", cameras=1)),
)
"""Rigs and what happens to them. In the last two rows it can only be known that something moved."""


@dataclass(frozen=True, slots=True)
class NamingResult:
    """What was named on one drive: when exactly the sensors that moved were, seconds after the fault (None: not in
    time), and whether a sensor that had not moved ever was."""

    delay_s: float | None
    wrong: bool


def report(drives: int, rigs: int, on_drive: Callable[[str], None]) -> RigMovesReport:
    """All rows: `drives` drives per fault, and `rigs` rigs whose windows are combined; `heard` hears of each drive."""
    return RigMovesReport(
        allowed_s=ALLOWED_S,
        moves=tuple(_row(rig, fault, drives, on_drive) for rig, fault in FAULTS),
        joint=tuple(joint_row(rig, rigs) for rig in (FOUR, FULL, UNLINKED)),
        knocked=tuple(displaced_lidar_row(rig, rigs) for rig in (FOUR, FULL, UNLINKED)),
    )


def _row(rig: SimulatedRig, fault: RigFault, drives: int, on_drive: Callable[[str], None]) -> MovesRow:
    driven = []
    for number in range(drives):
        driven.append(simulate_drive(rig, fault, number))
        on_drive(f"{rig.name}: {fault.name}")
    right = [one.delay_s for one in driven if one.delay_s is not None and not one.wrong]
    wrong = sum(one.wrong for one in driven)
    return MovesRow(
        rig=rig.name,
        fault=fault.name,
        drives=drives,
        right=len(right),
        undecided=drives - len(right) - wrong,
        wrong=wrong,
        delay_s=tuple(sorted(right)),
    )


def simulate_drive(rig: SimulatedRig, fault: RigFault, number: int) -> NamingResult:
    """One drive, drawn from its number. Where no sensor moves, the drive is right after 0 s if none is ever named."""
    rng = np.random.default_rng([SEED, number, *fault.name.encode(), *rig.name.encode()])
    cameras = [sensor.name for sensor in rig.graph.sensors if sensor.kind == "camera"]
    lidars = [sensor.name for sensor in rig.graph.sensors if sensor.kind == "lidar"]
    who = {str(name) for name in rng.permutation(cameras)[: fault.cameras]}
    who |= {str(name) for name in rng.permutation(lidars)[: fault.lidars]}
    before = off(rig.poses, BUILT, rng)
    after = moved(before, sorted(who), fault.angle_rad, rng)
    bend = None
    if fault.pairs:
        edge = rig.graph.edges[int(rng.integers(len(rig.graph.edges)))].name
        bend = Bend(edge, np.concatenate([fault.angle_rad * random_direction(rng), np.zeros(3)]))
    at_s = AT_S + float(rng.uniform(0.0, 20.0))
    delay_s: float | None = None if who else 0.0
    wrong = False
    state = initial(rig.graph)
    lasting = Lasting.of(rig, rng)
    for name, window in windows(rig, before, lasting, rng).items():
        state = served(state, name, window.T_camera_lidar, window.uncertainty.sigma)
    happening = Happening(before, after, bend, at_s, at_s + ALLOWED_S)
    checks = simulate_checks(rig, happening, rng)
    for at, named in _named(rig, state, checks, urgent_evidence(rig, happening, checks, lasting, rng)):
        if at > happening.until_s:
            break
        wrong = wrong or not named <= (who if at >= at_s else set())
        if who and delay_s is None and at >= at_s and named == who:
            delay_s = at - at_s
    return NamingResult(delay_s, wrong)


def _named(
    rig: SimulatedRig, state: RigState, checks: Sequence[TimedEvidence], accepted: Sequence[TimedEvidence]
) -> Iterator[tuple[float, set[str]]]:
    """The time, seconds, and the sensors named then, after each look or accepted window that changed the posterior."""
    updates = [*((timed, after_edge_observation) for timed in checks), *((timed, after_window) for timed in accepted)]
    for (at_s, evidence), after in sorted(updates, key=lambda one: one[0][0]):
        before, state = state, after(state, rig.graph, evidence)
        if state.posterior is not before.posterior:
            yield at_s, {one.name for one in sensors(state, rig.graph) if one.health in MOVED}


def joint_row(rig: SimulatedRig, rigs: int) -> JointRow:
    """How well the windows of each of `rigs` rigs combine into one estimate."""
    of_rig, of_pairs = np.zeros(6), np.zeros(6)
    nees: list[float] = []
    consistent = identified = missed = 0
    for number in range(rigs):
        rng = np.random.default_rng([SEED, number, *rig.name.encode()])
        poses = off(rig.poses, BUILT, rng)
        measurements = windows(rig, poses, Lasting.of(rig, rng), rng)
        result = estimate_jointly(rig.graph, measurements)
        consistent += result.consistent
        for edge in rig.graph.edges:
            truth = poses[edge.a] @ se3.inverse(poses[edge.b])
            error = se3.difference(result.T_a_b[edge.name], truth)
            of_rig += error**2
            of_pairs += se3.difference(measurements[edge.name].T_camera_lidar, truth) ** 2
            nees.append(float(error @ np.linalg.solve(result.between(edge.name, edge.name), error)) / 6.0)
        biased = estimate_jointly(rig.graph, windows(rig, poses, Lasting.of(rig, rng), rng, STEP_RAD))
        identified += biased.left_out == rig.graph.edges[0].name
        missed += biased.consistent
    ratio = np.sqrt(of_rig / of_pairs)
    rx, ry, rz, tx, ty, tz = ratio.tolist()
    each: Vector6 = (rx, ry, rz, tx, ty, tz)
    return JointRow(
        rig=rig.name, rigs=rigs, pairs=len(rig.graph.edges), rms_ratio=each,
        rms_ratio_all=float(np.sqrt(np.mean(ratio**2))), nees=float(np.mean(nees)), consistent=consistent,
        biased_found=identified, biased_missed=missed,
    )  # fmt: skip
