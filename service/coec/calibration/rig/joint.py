"""Where everything is: combines the windows of all pairs at one time over the graph (`system`).

If the pairs fit each other, the squared residuals are χ² distributed with six degrees of freedom for each loop to
close. If they are not, the edge without which they are is left out, provided that it is the only such edge (Baarda's
test). If several would do, nothing is left out: all loops that do not close are reported, and all standard deviations
widen by what the loops miss (Birge 1932).

After a move of a sensor, the graph also holds what was known before the move (`before`). That closes loops which are
not there otherwise, such as those between the cameras of a single LiDAR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.before import PreMoveKnowledge
from coec.calibration.rig.system import MeasuredEdge, Solution, System
from coec.calibration.rig.types import RigGraph, whose
from coec.calibration.tracker import Measurement, chi_square_tail
from coec.calibration.types import Matrix4
from coec.geometry import dense, se3

Array = NDArray[np.float64]

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
            `system.BUILT`.
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
        raise ValueError(f"{', '.join(strange)}: no edge of this rig, it has {', '.join(graph.edge)}")
    measured = tuple(name for name in graph.edge if name in windows and windows[name].determined_axes())
    if not measured:
        raise ValueError("no window says anything about this rig")
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
        covariance = covariance + dense.product(dense.product(before, one.covariance), before.T)
        determined &= one.information.diagonal() > 0.0
        here, at = np.asarray(step @ here), one.known.a if forward else one.known.b
    error = se3.difference(here, np.eye(4))
    axes = np.flatnonzero(determined) if determined.any() else np.arange(3)
    if not determined[:3].all():
        return Loop(tuple(one.known.name for one in way), float("nan"), float("nan"), 1.0)
    q = float(dense.squared(dense.inverse(covariance[np.ix_(axes, axes)]), error[axes]))
    return Loop(
        tuple(one.known.name for one in way),
        float(np.sqrt(np.sum(error[:3] ** 2))),
        float(np.sqrt(np.sum(error[3:] ** 2))) if determined[3:].all() else float("nan"),
        chi_square_tail(q, len(axes)),
    )
