"""`coec sim rig-moves`: does a rig name the sensors that moved, and no others? Tried on simulated evidence
(`rig_evidence`), drive after drive. Also: how much better a rig knows its pairs than each pair alone does, in
general and right after one of its LiDARs was displaced; and the tables of both rig experiments.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import degrees, radians
from statistics import median

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig import attribution
from coec.calibration.rig.joint_estimate import SHAKEN, JointEstimate, PreMoveKnowledge, estimate_jointly
from coec.calibration.tracker import Measurement, Track, prior_sigma, update_track
from coec.calibration.types import Matrix4
from coec.config import TrackerConfig
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec.reports import console
from coec.reports.formatting import count
from coec.schemas.replies import Vector6
from coec_lab.experiments.rig_evidence import (
    BUILT,
    FOUR,
    FULL,
    NS_PER_S,
    SINGLE,
    UNLINKED,
    Bend,
    Happening,
    Lasting,
    Poses,
    SimulatedRig,
    TimedEvidence,
    moved,
    off,
    simulate_checks,
    urgent_evidence,
    windows,
)
from coec_lab.experiments.simulation_schemas import JointRow, KnockedRow, MovesRow, RigDrivesReport, RigMovesReport

DISPLACED_SEED = 18_300_002
"""Any number from which nothing was learned."""

LIDAR = "roof"
"""The LiDAR that is knocked."""

STEP_RAD = radians(1.0)
"""Turn of a sensor that moves."""

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
        after = moved(shaken, (LIDAR,), STEP_RAD, rng)
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


AT_S, ALLOWED_S = 90.0, 60.0
"""About when sensors move, and how soon they must be named after that, s."""

SEED = 18_300_001
"""Any number from which nothing was learned."""

MOVED = frozenset({attribution.SensorHealth.CAMERA_MOVED, attribution.SensorHealth.LIDAR_MOVED})


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
    """All rows: `drives` drives per fault, and `rigs` rigs whose windows are combined; `on_drive` is called for
    each drive."""
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
    state = attribution.initial(rig.graph)
    lasting = Lasting.of(rig, rng)
    for name, window in windows(rig, before, lasting, rng).items():
        state = attribution.served(state, name, window.T_camera_lidar, window.uncertainty.sigma)
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
    rig: SimulatedRig, state: attribution.RigState, checks: Sequence[TimedEvidence], accepted: Sequence[TimedEvidence]
) -> Iterator[tuple[float, set[str]]]:
    """The time, seconds, and the sensors named then, after each look or accepted window that changed the posterior."""
    updates = [
        *((timed, attribution.after_edge_observation) for timed in checks),
        *((timed, attribution.after_window) for timed in accepted),
    ]
    for (at_s, evidence), after in sorted(updates, key=lambda one: one[0][0]):
        before, state = state, after(state, rig.graph, evidence)
        if state.posterior is not before.posterior:
            yield at_s, {one.name for one in attribution.sensors(state, rig.graph) if one.health in MOVED}


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


def show(report: RigMovesReport) -> None:
    """Prints which sensors were named, by fault; then how well the rig knows its pairs, in general and right after one
    of its LiDARs was knocked."""
    table = console.table(
        "rig", "fault", "drives", f"right in {report.allowed_s:g} s", "undecided", "wrong", "median", "latest",
        right=range(2, 8),
    )  # fmt: skip
    for row in report.moves:
        counts = (row.drives, row.right, row.undecided, row.wrong)
        table.add_row(row.rig, row.fault, *map(str, counts), *_late(row.delay_s))
    console.out.print(table)
    joint = console.table(
        "windows combined", "pairs", "rigs", "rms error, of single pairs", "NEES", "consistent", "1° off: found",
        "missed", right=range(1, 8),
    )  # fmt: skip
    for of in report.joint:
        joint.add_row(
            of.rig,
            str(of.pairs),
            str(of.rigs),
            _ratio(of.rms_ratio_all, of.rms_ratio),
            f"{of.nees:.2f}",
            *map(str, (of.consistent, of.biased_found, of.biased_missed)),
        )
    console.out.print(joint)
    displaced = console.table(
        "windows after a knocked LiDAR", "pairs", "rigs", "rms error, of single pairs", "without before", "NEES",
        "worst pair", "single", "consistent", "camera too, missed", right=range(1, 10),
    )  # fmt: skip
    for after in report.knocked:
        displaced.add_row(
            after.rig,
            str(after.pairs),
            str(after.rigs),
            _ratio(after.rms_ratio_all, after.rms_ratio),
            f"{after.rms_ratio_without:.2f}",
            f"{after.nees:.2f}",
            f"{after.worst_deg:.2f}°",
            f"{after.worst_of_pairs_deg:.2f}°",
            *map(str, (after.consistent, after.also_missed)),
        )
    console.out.print(displaced)


def show_drives(report: RigDrivesReport) -> None:
    """Prints which sensors were named on rendered drives, by fault; then each drive that did not end right."""
    table = console.table(
        "rendered", "drives", f"right in {report.allowed_s:g} s", "undecided", "wrong", "named: median", "latest",
        "a pair alarmed: drives", "median", "latest", right=range(1, 10),
    )  # fmt: skip
    for row in report.moves:
        counts = map(str, (row.drives, row.right, row.undecided, row.wrong))
        table.add_row(row.fault, *counts, *_late(row.delay_s), str(len(row.alarms_s)), *_late(row.alarms_s))
    console.out.print(table)
    for row in report.moves:
        for one in row.each:
            if one.wrong:
                console.show(f"  {one.name}, {row.fault}: {', '.join(one.wrong)} named {one.wrong_s:+.0f} s after it")
            elif one.named_s is None:
                console.show(f"  {one.name}, {row.fault}: {' and '.join(one.moved)} not named")
    of = f"{count(report.looks, 'look')} on {count(report.drives, 'drive')} with {report.camera}"
    windows = f"{report.windows} urgent windows: {report.accepted} accepted"
    console.show(f"{of}: {report.faint} faint, {report.blind} blind; {windows}; {count(report.failed, 'drive')} failed")


def _ratio(of_all: float, per_axis: Sequence[float]) -> str:
    return f"{of_all:.2f} ({' '.join(f'{ratio:.2f}' for ratio in per_axis)})"


def _late(seconds: tuple[float, ...]) -> tuple[str, str]:
    return (f"{median(seconds):.0f} s", f"{max(seconds):.0f} s") if seconds else ("-", "-")
