"""The joint estimate of all sensors of a rig: least squares over the graph, from the windows of all pairs at one time,
and from what was known before some sensors moved and is still true after the move.

The unknowns are the poses of the sensors, each moved by x (6,) from where the vehicle was built, and one number for
every error that windows share. For example, a displaced lens displaces every pair of its camera; how far, each window
states for itself (`uncertainty.systematic`). Least squares over both, iterated from the poses found (Gauss, Newton):

ξ_measured = x_a - Ad(T_a_b) · x_b + Σ s_k · z_k + noise, x ~ N(0, P), z ~ N(0, 1)

The gauge: only differences are measured, so a prior on every mount, the same for all sensors, holds the whole rig in
place. The pose of a pair, its covariance and the covariances between pairs do not depend on the gauge.

A knocked LiDAR leaves the cameras where they were to one another, so all that was known about that still holds.
Therefore a sensor that moved is two nodes of the graph: where it was, and where it is. What was known of its pairs
joins the first node to the sensors that stood still; windows from after the move join the second. Nothing joins the two
nodes. So all pairs of the sensor determine the move together, and loops close that did not before: every pair has to
show the same move.

What was known is less certain than it was, because mounts creep with time and a knock shakes the other mounts too.
Errors that the scenes of that time had in common are noise beside the scenes of now; a displaced lens stays displaced.

If the pairs fit each other, the squared residuals are χ² distributed with six degrees of freedom for each loop to
close. If they are not, the edge without which they are is left out, provided that it is the only such edge (Baarda's
test). If several would do, nothing is left out: all loops that do not close are reported, and all standard deviations
widen by what the loops miss (Birge 1932).

After a move of a sensor, the graph also holds what was known before the move (`before`). That closes loops which are
not there otherwise, such as those between the cameras of a single LiDAR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import fsum, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.edge_observations import information_of
from coec.calibration.rig.graph import Edge, KnownTransform, RigGraph, RigidLink, Sensor, was, whose
from coec.calibration.tracker import NS_PER_H, Measurement, chi_square_tail, creep_sigma
from coec.calibration.types import Matrix4
from coec.config import TrackerConfig
from coec.geometry import linalg, se3

Array = NDArray[np.float64]


BUILT = np.array([radians(5.0)] * 3 + [0.3] * 3)
"""How far each sensor may be from where the vehicle was built (rad, m): wide beside all that is measured, because it
only has to hold what nothing else holds."""

ROUNDS, STILL = 8, 1e-12
"""Most Gauss-Newton rounds, and the step (rad, m) below which they stop."""


@dataclass(frozen=True, slots=True)
class Owner:
    """Which sensor owns a systematic error: through which of its ends an edge shares the error with other edges. If
    through neither, the error is the pair's own."""

    of_a: float
    of_b: float


LENS, SWEEP, CLOCKS, OWN = Owner(1.0, 0.0), Owner(0.0, 1.0), Owner(sqrt(0.5), sqrt(0.5)), Owner(0.0, 0.0)
"""Parts of each owner, by standard deviation. Stamps are rounded at both sensors, so each clock owns √½."""

OWNERS: Mapping[str, Owner] = {
    "lens_across": LENS,
    "lens_down": LENS,
    "lens_scale": LENS,
    "lens_radial": LENS,
    "near_edges_across": LENS,
    "near_edges_down": LENS,
    "columns": SWEEP,
    "stamps": CLOCKS,
    "clock_offset": CLOCKS,
    "clock_drift": CLOCKS,
    "readout": CLOCKS,
}
"""The owner of each error by its name in `uncertainty.systematic`; any other error is the pair's own."""

LASTING = frozenset({"lens_across", "lens_down", "lens_scale", "lens_radial"})
"""Errors that a sensor has whatever it sees. The others change with the scene: how far edges of near things, or
columns, lie aside depends on it."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredEdge:
    """An edge or a link that was measured."""

    known: KnownTransform
    T_a_b: Matrix4
    information: Array  # (6, 6) of the noise
    shared: Mapping[str, Array]  # (6,) shift by one standard deviation, by owner and name of the error

    @property
    def covariance(self) -> Array:
        """(6, 6) of all errors; at least as wide as `BUILT` on axes that were not determined."""
        noise = linalg.inverse(self.information + np.diag(1.0 / BUILT**2) * 1e-2)
        for name in sorted(self.shared):
            noise = noise + self.shared[name][:, None] * self.shared[name]
        return noise


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The poses (S of (4, 4)), the sum of squares with its degrees of freedom, and the covariance of all edges."""

    poses: tuple[Matrix4, ...]
    chi2: float
    freedom: int
    of_edges: Array


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """All measurements, and the names of the shared errors, each of which is one unknown."""

    graph: RigGraph
    measured: tuple[MeasuredEdge, ...]
    errors: tuple[str, ...]

    @classmethod
    def of(cls, graph: RigGraph, windows: Mapping[str, Measurement]) -> System:
        """The system of one window for each edge that has one, by its name, and of all links.

        Raises:
            ValueError: a pose is not rigid, or a covariance is invalid.
        """
        measured = []
        for known in graph.known:
            if known.name in windows:
                measured.append(_of_window(known, windows[known.name]))
        measured += [
            MeasuredEdge(
                KnownTransform(link.name, link.a, link.b, link.T_a_b), link.T_a_b, np.diag(1.0 / link.sigma**2), {}
            )
            for link in graph.links
        ]
        errors = sorted({name for one in measured for name in one.shared})
        return cls(graph, tuple(measured), tuple(errors))

    def predicted(self, poses: Sequence[Matrix4], a: str, b: str) -> Matrix4:
        """T_a_b (4, 4) at some poses."""
        return np.asarray(poses[self.graph.place[a]] @ se3.inverse(poses[self.graph.place[b]]))

    def solved(self, without: frozenset[str]) -> Solution:
        """The least-squares solution without some edges."""
        built = self.graph.poses
        poses, shared = built, np.zeros(len(self.errors))
        there = [one for one in self.measured if one.known.name not in without]
        n = 6 * len(built)
        prior = np.concatenate([np.tile(1.0 / BUILT**2, len(built)), np.ones(len(self.errors))])
        for _ in range(ROUNDS):
            normal, pull = np.diag(prior), np.zeros(len(prior))
            for place, (pose, before) in enumerate(zip(poses, built, strict=True)):
                of = slice(6 * place, 6 * place + 6)
                pull[of] = -prior[of] * se3.difference(pose, before)
            pull[n:] = -shared
            for one in there:
                design, away = self._linear(one, poses, shared)
                turned = linalg.product(design.T, one.information)
                normal += linalg.product(turned, design)
                pull += linalg.applied(turned, away)
            step = linalg.cholesky_solve(linalg.cholesky(normal), pull[:, None])[:, 0]
            poses = tuple(se3.perturb(pose, step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses))
            shared = shared + step[n:]
            if np.abs(step).max() < STILL:
                break
        squares = [float(z) ** 2 for z in shared.tolist()]
        for one in there:
            squares.append(float(linalg.squared(one.information, self._linear(one, poses, shared)[1])))
        covariance = linalg.inverse(normal)[:n, :n]
        measured_axes = sum(int(np.count_nonzero(one.information.diagonal())) for one in there)
        settled = n - fsum((covariance.diagonal() * prior[:n]).tolist())
        design = np.concatenate([self._design(poses, known.a, known.b) for known in self.graph.known])
        design = design[: 6 * len(self.graph.edges)]
        return Solution(
            poses=poses,
            chi2=fsum(squares),
            freedom=max(round(measured_axes - settled), 0),
            of_edges=linalg.product(linalg.product(design, covariance), design.T),
        )

    def _linear(self, one: MeasuredEdge, poses: Sequence[Matrix4], shared: Array) -> tuple[Array, Array]:
        """The derivative (6, unknowns) of a measurement, and its residual (6,) at some poses."""
        known = one.known
        away = se3.difference(one.T_a_b, self.predicted(poses, known.a, known.b))
        common = np.zeros((6, len(self.errors)))
        for place, name in enumerate(self.errors):
            if name in one.shared:
                common[:, place] = one.shared[name]
        return np.concatenate([self._design(poses, known.a, known.b), common], axis=1), away - linalg.applied(
            common, shared
        )

    def _design(self, poses: Sequence[Matrix4], a: str, b: str) -> Array:
        """(6, 6·S) how T_a_b moves with the sensors."""
        design = np.zeros((6, 6 * len(poses)))
        i, j = 6 * self.graph.place[a], 6 * self.graph.place[b]
        design[:, i : i + 6] = np.eye(6)
        design[:, j : j + 6] = -se3.adjoint(self.predicted(poses, a, b))
        return design


def _of_window(known: KnownTransform, window: Measurement) -> MeasuredEdge:
    if not se3.is_rigid(window.T_camera_lidar):
        raise ValueError(f"{known.name}: a pose must be a rigid transform (4, 4) of finite numbers")
    try:
        information = information_of(window.uncertainty.noise)
    except ValueError as error:
        raise ValueError(f"{known.name}: {error}") from error
    determined = information.diagonal() > 0.0
    shared: dict[str, Array] = {}
    for name, shift in window.uncertainty.systematic.items():
        if shift.shape != (6,) or not np.isfinite(shift[determined]).all() or np.abs(shift[determined]).max() > 10.0:
            raise ValueError(f"{known.name}: the error {name} must be a shift of six finite numbers")
        owner = OWNERS.get(name, OWN)
        parts = ((f"{whose(known.a)} {name}", owner.of_a), (f"{whose(known.b)} {name}", owner.of_b))
        if owner is OWN:
            parts = ((f"{known.name} {name}", 1.0), ("", 0.0))
        shared |= {of: part * np.where(determined, shift, 0.0) for of, part in parts if part > 0.0}
    return MeasuredEdge(known, window.T_camera_lidar, information, shared)


SHAKEN = np.array([radians(0.02)] * 3 + [0.003] * 3)
"""(6,) standard deviation by which a knock changes the pose between two sensors neither of which it moves (rad, m).
Chosen: a third of the uncertainty of a window. A mount that shifts by more was itself knocked, which the loops show."""

CREEP = creep_sigma(TrackerConfig())
"""(6,) standard deviation of the creep of a mount in an hour (rad, m): the default of the pairs."""


@dataclass(frozen=True, slots=True, eq=False)
class PreMoveKnowledge:
    """What was known before a move.

    Attributes:
        sensors: those that moved since.
        edges: what was known of each edge that ends at one of them, by name.
    """

    sensors: tuple[str, ...]
    edges: Mapping[str, Measurement]

    @classmethod
    def of(
        cls, sensors: tuple[str, ...], known: Mapping[str, Sequence[Measurement]], right_ns: int, stamp_ns: int
    ) -> PreMoveKnowledge:
        """From what was known of each edge at several times, oldest first: the latest up to `right_ns`, when nothing
        had moved yet, with the uncertainty that it has at `stamp_ns`, when these sensors had moved."""
        right = {name: [one for one in of if one.stamp_ns <= right_ns] for name, of in known.items()}
        return cls(sensors, {name: remembered(of[-1], stamp_ns) for name, of in right.items() if of})

    @property
    def measured(self) -> Mapping[str, Measurement]:
        """What was known, by the names that `joined` gives its edges."""
        return {was(name): known for name, known in self.edges.items()}

    def joined(self, graph: RigGraph) -> RigGraph:
        """The graph with two nodes for each sensor that moved, and with extra edges for what was known. Links at those
        sensors are doubled too, because a bar held before the move as it does now."""
        old = {name: was(name) if name in self.sensors else name for name in graph.place}
        sensors = [Sensor(was(sensor.name), sensor.kind) for sensor in graph.sensors if sensor.name in self.sensors]
        edges = [
            Edge(was(edge.name), old[edge.a], old[edge.b], edge.T_a_b)
            for edge in graph.edges
            if edge.name in self.edges
        ]
        links = [
            RigidLink(was(link.name), old[link.a], old[link.b], link.T_a_b, link.sigma)
            for link in graph.links
            if {link.a, link.b} & set(self.sensors)
        ]
        # No sensor is new: the limit on the number of sensors bounds these nodes, too.
        return RigGraph(
            tuple(sorted((*graph.sensors, *sensors), key=lambda sensor: sensor.name)),
            tuple(sorted((*graph.edges, *edges), key=lambda edge: edge.name)),
            tuple(sorted((*graph.links, *links), key=lambda link: link.name)),
        )


def remembered(known: Measurement, stamp_ns: int) -> Measurement:
    """What was known of a pair at its own stamp, with the uncertainty that it has at `stamp_ns`, after a knock in
    between."""
    hours = max(stamp_ns - known.stamp_ns, 0) / NS_PER_H
    uncertainty = known.uncertainty
    noise = uncertainty.noise + np.diag(SHAKEN**2 + hours * CREEP**2)
    lasting = {}
    for name in sorted(uncertainty.systematic):
        shift = uncertainty.systematic[name]
        if name in LASTING:
            lasting[name] = shift
        else:
            noise = noise + shift[:, None] * shift
    return replace(known, uncertainty=replace(uncertainty, noise=noise, systematic=lasting))


INCONSISTENT_AT = 1e-3
"""Chance of a sum of squares below which the pairs do not fit each other: by chance that happens once in a thousand
windows, which is fifty hours."""

ALONE_BY = 12.0
"""An edge alone is at fault if leaving it out lowers the sum of squares by this much more than leaving out any other:
odds of 400 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A way along edges and links that ends where it begins.

    Attributes:
        names: of the edges and links, in their order.
        rotation_rad, translation_m: the error by which the loop does not close; NaN if not all axes were determined.
        chance: probability of an error at least as large.
    """

    names: tuple[str, ...]
    rotation_rad: float
    translation_m: float
    chance: float


@dataclass(frozen=True, slots=True, eq=False)
class JointEstimate:
    """The rig, as all windows together put it.

    Attributes:
        stamp_ns: of the newest window in it.
        poses: T_sensor_rig (4, 4) of each sensor, by name; the gauge is where the vehicle was built.
        T_a_b: (4, 4) of each edge of the graph, measured or not, by name.
        covariance: (6·E, 6·E) of the perturbations of all edges about the axes of their first sensors, in the order of
            `T_a_b`, including the covariances between edges. An edge that nothing measured is as wide as
            `BUILT`.
        measured: edges that a window measured.
        chi2, freedom, chance: how well all windows fit each other: the sum of squares, its degrees of freedom (0 if no
            loop closes), and the chance of a sum as large.
        left_out: the edge that alone did not fit, if there is one; `chi2` includes it. After a move, what was known of
            that edge before may be what does not fit; then its window is not left out.
        open_loops: loops that do not close, the least likely first; `types.was` of a name is what was known before.
        widened: factor on all standard deviations, for what the loops miss.
    """

    stamp_ns: int
    poses: Mapping[str, Matrix4]
    T_a_b: Mapping[str, Matrix4]
    covariance: Array
    measured: tuple[str, ...]
    chi2: float
    freedom: int
    chance: float
    left_out: str | None
    open_loops: tuple[Loop, ...]
    widened: float

    @property
    def consistent(self) -> bool:
        """Whether the pairs fit each other."""
        return self.chance >= INCONSISTENT_AT

    def between(self, edge: str, other: str) -> Array:
        """(6, 6) covariance of the errors of two edges; for the same edge twice, its own covariance."""
        order = list(self.T_a_b)
        i, j = 6 * order.index(edge), 6 * order.index(other)
        return self.covariance[i : i + 6, j : j + 6]


def estimate_jointly(
    graph: RigGraph, windows: Mapping[str, Measurement], before: PreMoveKnowledge | None = None
) -> JointEstimate:
    """The rig from one window for each edge that has one, by its name, and from what was known `before` a move. Windows
    that determine no axis are ignored.

    Raises:
        ValueError: no window determines anything; one is of no edge; a pose is not rigid, or a covariance is invalid.
    """
    if strange := sorted(set(windows) - set(graph.edge)):
        raise ValueError(f"{', '.join(strange)}: not an edge of this rig; its edges are {', '.join(graph.edge)}")
    measured = tuple(name for name in graph.edge if name in windows and windows[name].determined_axes())
    if not measured:
        raise ValueError("no window constrains this rig")
    measurements = {name: windows[name] for name in measured}
    system = (
        System.of(graph, measurements)
        if before is None
        else System.of(before.joined(graph), {**measurements, **before.measured})
    )
    solution = system.solved(frozenset())
    chi2, freedom = solution.chi2, solution.freedom
    chance = chi_square_tail(chi2, freedom) if freedom else 1.0
    left_out: str | None = None
    widened = 1.0
    loops: tuple[Loop, ...] = ()
    if chance < INCONSISTENT_AT:
        loops = _open_loops(system)
        left_out = _alone_at_fault(system, solution)
        if left_out is not None:
            solution = system.solved(frozenset({left_out}))
        else:
            widened = sqrt(chi2 / freedom)
    places = system.graph.place
    rows = np.concatenate(
        [np.arange(6) + 6 * k for k, edge in enumerate(system.graph.edges) if edge.name in graph.edge]
    )
    return JointEstimate(
        stamp_ns=max(windows[name].stamp_ns for name in measured),
        poses={sensor.name: solution.poses[places[sensor.name]] for sensor in graph.sensors},
        T_a_b={edge.name: system.predicted(solution.poses, edge.a, edge.b) for edge in graph.edges},
        covariance=solution.of_edges[np.ix_(rows, rows)] * widened**2,
        measured=measured,
        chi2=chi2,
        freedom=freedom,
        chance=chance,
        left_out=None if left_out is None else whose(left_out),
        open_loops=loops,
        widened=widened,
    )


def _alone_at_fault(system: System, solution: Solution) -> str | None:
    """The one edge without which the others fit; None if there is none, or more than one. Links are taken for granted,
    because it is windows that fail. If leaving out the window of a pair helps as much as leaving out what was known of
    the pair before a move, the latter is left out: what a pair says by itself stands."""
    measured = [one.known.name for one in system.measured if one.known.name in system.graph.edge]
    without = {name: system.solved(frozenset({name})) for name in measured}
    by_gain = sorted(measured, key=lambda name: (without[name].chi2, name))
    first = by_gain[0]
    best = without[first]
    if best.freedom and chi_square_tail(best.chi2, best.freedom) < INCONSISTENT_AT:
        return None
    if not best.freedom and solution.freedom <= 6:
        return None  # nothing is left that could confirm the others
    as_good = [name for name in by_gain if without[name].chi2 - best.chi2 < ALONE_BY]
    if any(whose(name) != whose(first) for name in as_good):
        return None
    return max(as_good, key=lambda name: (name != whose(name), name == first))


def _open_loops(system: System) -> tuple[Loop, ...]:
    """Those loops that do not close, out of the shortest loop through each edge and link."""
    measured = {one.known.name: one for one in system.measured}
    paths = [system.graph.loop_through(name, list(measured)) for name in measured]
    unique: dict[frozenset[str], tuple[str, ...]] = {}
    for way in paths:
        if way is not None:
            unique.setdefault(frozenset(way), way)
    loops = [_closed([measured[name] for name in way]) for way in unique.values()]
    at = INCONSISTENT_AT / max(len(loops), 1)  # one of many loops may fail to close by chance
    return tuple(sorted((loop for loop in loops if loop.chance < at), key=lambda loop: (loop.chance, loop.names)))


def _closed(way: Sequence[MeasuredEdge]) -> Loop:
    """The error left after a way along all of these, from the second end of the first one back to it."""
    here, at = np.eye(4), way[0].known.b
    covariance, determined = np.zeros((6, 6)), np.ones(6, np.bool_)
    for one in way:
        forward = one.known.b == at
        step = one.T_a_b if forward else se3.inverse(one.T_a_b)
        # A perturbation on the left of T_a_b, about the axes of where the way began.
        before = se3.adjoint(se3.inverse(here)) if not forward else se3.adjoint(se3.inverse(step @ here))
        covariance = covariance + linalg.product(linalg.product(before, one.covariance), before.T)
        determined &= one.information.diagonal() > 0.0
        here, at = np.asarray(step @ here), one.known.a if forward else one.known.b
    error = se3.difference(here, np.eye(4))
    axes = np.flatnonzero(determined) if determined.any() else np.arange(3)
    if not determined[:3].all():
        return Loop(tuple(one.known.name for one in way), float("nan"), float("nan"), 1.0)
    q = float(linalg.squared(linalg.inverse(covariance[np.ix_(axes, axes)]), error[axes]))
    return Loop(
        tuple(one.known.name for one in way),
        float(np.sqrt(np.sum(error[:3] ** 2))),
        float(np.sqrt(np.sum(error[3:] ** 2))) if determined[3:].all() else float("nan"),
        chi_square_tail(q, len(axes)),
    )
