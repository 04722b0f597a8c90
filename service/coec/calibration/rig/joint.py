"""Where everything is: the windows of all pairs of one time, combined over the graph.

The unknowns are the poses of the sensors, moved by x (6,) each from where the vehicle was built, and one number for
every error that windows share: a lens that is displaced displaces every pair of its camera, in a way that each window
tells for itself (`confidence.budget`). Least squares over both, iterated from the poses found (Gauss, Newton):

    ξ_measured = x_a - Ad(T_a_b) · x_b + Σ s_k · z_k + noise,      x ~ N(0, P),  z ~ N(0, 1)

The gauge: only differences are measured, so the whole rig is held by what is known of the mounts before, every sensor
alike. What is told of a pair does not depend on it, its covariance and those between pairs neither.

Do the pairs fit each other? The squared residuals are χ² distributed with as many degrees of freedom as there are loops
to close, six each. Where they are not, the edge without which they are is left out, if it is the only one (Baarda's
test); if several would do, nothing is left out, all loops are told that do not close, and what is claimed widens by
what they miss (Birge 1932).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import fsum, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.evidence import information_of
from coec.calibration.rig.types import Known, RigGraph
from coec.calibration.tracker import Measurement, chi_square_tail
from coec.calibration.types import Matrix4
from coec.geometry import dense, se3

Array = NDArray[np.float64]

BUILT = np.array([radians(5.0)] * 3 + [0.3] * 3)
"""How far each sensor may be from where the vehicle was built (rad, m): wide beside all that is measured, as it only
holds what nothing else does."""

INCONSISTENT_AT = 1e-3
"""Chance of a sum of squares, below which the pairs do not fit each other: once in a thousand windows by chance, fifty
hours of them."""

ALONE_BY = 12.0
"""By how much more leaving out one edge lowers the sum of squares than leaving out any other, for it to be the only one
at fault: odds of 400 to 1."""

ROUNDS, STILL = 8, 1e-12
"""Of Gauss and Newton at most, and the step (rad, m) at which they stand still."""


@dataclass(frozen=True, slots=True)
class Owner:
    """Whose a systematic error is: by which of its ends an edge shares it with others. Of neither end, it is the
    pair's own."""

    of_a: float
    of_b: float


LENS, SWEEP, CLOCKS, OWN = Owner(1.0, 0.0), Owner(0.0, 1.0), Owner(sqrt(0.5), sqrt(0.5)), Owner(0.0, 0.0)
"""Parts by standard deviation. A stamp is rounded at either sensor."""

OWNERS: Mapping[str, Owner] = {
    "lens_across": LENS,
    "lens_down": LENS,
    "lens_scale": LENS,
    "near_edges_across": LENS,
    "near_edges_down": LENS,
    "columns": SWEEP,
    "stamps": CLOCKS,
}
"""By the names of `confidence.budget`; any other error is the pair's own."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A way along edges and links that ends where it begins.

    Attributes:
        names: of these, in their order.
        rotation_rad, translation_m: by how much it does not close.
        chance: of an error that large or larger.
    """

    names: tuple[str, ...]
    rotation_rad: float
    translation_m: float
    chance: float


@dataclass(frozen=True, slots=True, eq=False)
class JointEstimate:
    """The rig.

    Attributes:
        stamp_ns: of the newest window in it.
        poses: T_sensor_rig (4, 4) of each sensor, by name, the rig held by where the vehicle was built.
        T_a_b: (4, 4) of each edge of the graph, measured or not, by name.
        covariance: (6·E, 6·E) of the perturbations of all edges about the axes of their first sensors, in the order of
            `T_a_b`: those between edges included. Where nothing measured an edge it is as wide as `BUILT` has it.
        measured: edges that a window told.
        chi2, freedom, chance: how well all windows fit each other: the sum of squares, its degrees of freedom, 0 where
            no loop closes, and the chance of one as large.
        left_out: the edge that alone did not fit, if one was; `chi2` is that with it.
        open_loops: loops that do not close, the least likely first.
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
        """(6, 6) covariance of the errors of two edges; of one and itself its own."""
        order = list(self.T_a_b)
        i, j = 6 * order.index(edge), 6 * order.index(other)
        return self.covariance[i : i + 6, j : j + 6]


def estimate(graph: RigGraph, windows: Mapping[str, Measurement]) -> JointEstimate:
    """The rig from one window of each edge that has one, by its name. Windows that tell no axis are left aside.

    Raises:
        ValueError: no window tells anything; one is of no edge; a pose is not rigid, or a covariance no covariance.
    """
    if strange := sorted(set(windows) - set(graph.edge)):
        raise ValueError(f"{', '.join(strange)}: no edge of this rig, it has {', '.join(graph.edge)}")
    measured = tuple(name for name in graph.edge if name in windows and windows[name].told_axes())
    if not measured:
        raise ValueError("no window tells anything of this rig")
    system = _System.of(graph, {name: windows[name] for name in measured})
    solution = system.solved(frozenset())
    chi2, freedom = solution.chi2, solution.freedom
    chance = chi_square_tail(chi2, freedom) if freedom else 1.0
    left_out: str | None = None
    widened = 1.0
    loops: tuple[Loop, ...] = ()
    if chance < INCONSISTENT_AT:
        loops = _open_loops(graph, system)
        left_out = _alone_at_fault(system, solution, measured)
        if left_out is not None:
            solution = system.solved(frozenset({left_out}))
        else:
            widened = sqrt(chi2 / freedom)
    return JointEstimate(
        stamp_ns=max(windows[name].stamp_ns for name in measured),
        poses={sensor.name: pose for sensor, pose in zip(graph.sensors, solution.poses, strict=True)},
        T_a_b={edge.name: system.predicted(solution.poses, edge.a, edge.b) for edge in graph.edges},
        covariance=solution.of_edges * widened**2,
        measured=measured,
        chi2=chi2,
        freedom=freedom,
        chance=chance,
        left_out=left_out,
        open_loops=loops,
        widened=widened,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """An edge or a link that was measured."""

    known: Known
    T_a_b: Matrix4
    information: Array  # (6, 6) of the noise
    shared: Mapping[str, Array]  # by whose error it is, (6,)

    @property
    def covariance(self) -> Array:
        """(6, 6) of all errors; on axes that were not told as wide as `BUILT`."""
        noise = dense.inverse(self.information + np.diag(1.0 / BUILT**2) * 1e-2)
        for name in sorted(self.shared):
            noise = noise + self.shared[name][:, None] * self.shared[name]
        return noise


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Poses (S of (4, 4)), the sum of squares with its degrees of freedom, and the covariance of all edges."""

    poses: tuple[Matrix4, ...]
    chi2: float
    freedom: int
    of_edges: Array


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """All that was measured, and the errors in common, each a number of its own."""

    graph: RigGraph
    measured: tuple[_Measured, ...]
    errors: tuple[str, ...]

    @classmethod
    def of(cls, graph: RigGraph, windows: Mapping[str, Measurement]) -> _System:
        measured = []
        for known in graph.known:
            if known.name in windows:
                measured.append(_of_window(known, windows[known.name]))
        measured += [
            _Measured(Known(link.name, link.a, link.b, link.T_a_b), link.T_a_b, np.diag(1.0 / link.sigma**2), {})
            for link in graph.links
        ]
        errors = sorted({name for one in measured for name in one.shared})
        return cls(graph, tuple(measured), tuple(errors))

    def predicted(self, poses: Sequence[Matrix4], a: str, b: str) -> Matrix4:
        """T_a_b (4, 4) at some poses."""
        return np.asarray(poses[self.graph.place[a]] @ se3.inverse(poses[self.graph.place[b]]))

    def solved(self, without: frozenset[str]) -> _Solution:
        """The least squares, without some edges."""
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
                turned = dense.product(design.T, one.information)
                normal += dense.product(turned, design)
                pull += dense.applied(turned, away)
            step = dense.solved(dense.cholesky(normal), pull[:, None])[:, 0]
            poses = tuple(se3.perturb(pose, step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses))
            shared = shared + step[n:]
            if np.abs(step).max() < STILL:
                break
        squares = [float(z) ** 2 for z in shared.tolist()]
        for one in there:
            squares.append(float(dense.squared(one.information, self._linear(one, poses, shared)[1])))
        covariance = dense.inverse(normal)[:n, :n]
        told = sum(int(np.count_nonzero(one.information.diagonal())) for one in there)
        settled = n - fsum((covariance.diagonal() * prior[:n]).tolist())
        design = np.concatenate([self._design(poses, known.a, known.b) for known in self.graph.known])
        design = design[: 6 * len(self.graph.edges)]
        return _Solution(
            poses=poses,
            chi2=fsum(squares),
            freedom=max(round(told - settled), 0),
            of_edges=dense.product(dense.product(design, covariance), design.T),
        )

    def _linear(self, one: _Measured, poses: Sequence[Matrix4], shared: Array) -> tuple[Array, Array]:
        """Of what was measured: its derivative (6, unknowns), and by how much it is off (6,) at some poses."""
        known = one.known
        away = se3.difference(one.T_a_b, self.predicted(poses, known.a, known.b))
        common = np.zeros((6, len(self.errors)))
        for place, name in enumerate(self.errors):
            if name in one.shared:
                common[:, place] = one.shared[name]
        return np.concatenate([self._design(poses, known.a, known.b), common], axis=1), away - dense.applied(
            common, shared
        )

    def _design(self, poses: Sequence[Matrix4], a: str, b: str) -> Array:
        """(6, 6·S) how T_a_b moves with the sensors."""
        design = np.zeros((6, 6 * len(poses)))
        i, j = 6 * self.graph.place[a], 6 * self.graph.place[b]
        design[:, i : i + 6] = np.eye(6)
        design[:, j : j + 6] = -se3.adjoint(self.predicted(poses, a, b))
        return design


def _of_window(known: Known, window: Measurement) -> _Measured:
    if not se3.is_rigid(window.T_camera_lidar):
        raise ValueError(f"{known.name}: a pose must be a rigid transform (4, 4) of finite numbers")
    try:
        information = information_of(window.uncertainty.noise)
    except ValueError as error:
        raise ValueError(f"{known.name}: {error}") from error
    told = information.diagonal() > 0.0
    shared: dict[str, Array] = {}
    for name, shift in window.uncertainty.systematic.items():
        if shift.shape != (6,) or not np.isfinite(shift[told]).all() or np.abs(shift[told]).max() > 10.0:
            raise ValueError(f"{known.name}: the error {name} is no shift of six finite numbers")
        owner = OWNERS.get(name, OWN)
        parts = ((f"{known.a} {name}", owner.of_a), (f"{known.b} {name}", owner.of_b))
        if owner is OWN:
            parts = ((f"{known.name} {name}", 1.0), ("", 0.0))
        shared |= {of: part * np.where(told, shift, 0.0) for of, part in parts if part > 0.0}
    return _Measured(known, window.T_camera_lidar, information, shared)


def _alone_at_fault(system: _System, solution: _Solution, measured: Sequence[str]) -> str | None:
    """The one edge without which the others fit, None if there is none or more than one. Links are taken for granted:
    it is windows that fail."""
    without = {name: system.solved(frozenset({name})) for name in measured}
    by_gain = sorted(measured, key=lambda name: (without[name].chi2, name))
    best = without[by_gain[0]]
    if best.freedom and chi_square_tail(best.chi2, best.freedom) < INCONSISTENT_AT:
        return None
    if not best.freedom and solution.freedom <= 6:
        return None  # nothing is left that could speak for the others
    if len(by_gain) > 1 and without[by_gain[1]].chi2 - best.chi2 < ALONE_BY:
        return None
    return by_gain[0]


def _open_loops(graph: RigGraph, system: _System) -> tuple[Loop, ...]:
    """The shortest loop through each edge and link, of those that do not close."""
    measured = {one.known.name: one for one in system.measured}
    ways = [graph.loop_through(name, list(measured)) for name in measured]
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for way in ways:
        if way is not None:
            found.setdefault(frozenset(way), way)
    loops = [_closed([measured[name] for name in way]) for way in found.values()]
    at = INCONSISTENT_AT / max(len(loops), 1)  # one of many is unlikely by chance
    return tuple(sorted((loop for loop in loops if loop.chance < at), key=lambda loop: (loop.chance, loop.names)))


def _closed(way: Sequence[_Measured]) -> Loop:
    """What is left of a way along all of these, from the second end of the first one back to it."""
    here, at = np.eye(4), way[0].known.b
    covariance, told = np.zeros((6, 6)), np.ones(6, np.bool_)
    for one in way:
        forward = one.known.b == at
        step = one.T_a_b if forward else se3.inverse(one.T_a_b)
        # A perturbation on the left of T_a_b, about the axes of where the way began.
        before = se3.adjoint(se3.inverse(here)) if not forward else se3.adjoint(se3.inverse(step @ here))
        covariance = covariance + dense.product(dense.product(before, one.covariance), before.T)
        told &= one.information.diagonal() > 0.0
        here, at = np.asarray(step @ here), one.known.a if forward else one.known.b
    error = se3.difference(here, np.eye(4))
    axes = np.flatnonzero(told) if told.any() else np.arange(3)
    if not told[:3].all():
        return Loop(tuple(one.known.name for one in way), float("nan"), float("nan"), 1.0)
    q = float(dense.squared(dense.inverse(covariance[np.ix_(axes, axes)]), error[axes]))
    return Loop(
        tuple(one.known.name for one in way),
        float(np.sqrt(np.sum(error[:3] ** 2))),
        float(np.sqrt(np.sum(error[3:] ** 2))) if told[3:].all() else float("nan"),
        chi_square_tail(q, len(axes)),
    )
