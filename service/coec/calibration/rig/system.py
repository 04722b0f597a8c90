"""The least squares over the graph of a rig: finds where all sensors are from what was measured between them.

The unknowns are the poses of the sensors, each moved by x (6,) from where the vehicle was built, and one number for
every error that windows share. For example, a displaced lens displaces every pair of its camera; how far, each window
states for itself (`confidence.budget`). Least squares over both, iterated from the poses found (Gauss, Newton):

    ξ_measured = x_a - Ad(T_a_b) · x_b + Σ s_k · z_k + noise,      x ~ N(0, P),  z ~ N(0, 1)

The gauge: only differences are measured, so a prior on every mount, the same for all sensors, holds the whole rig in
place. The pose of a pair, its covariance and the covariances between pairs do not depend on the gauge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import fsum, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.evidence import information_of
from coec.calibration.rig.types import KnownTransform, RigGraph, whose
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4
from coec.geometry import dense, se3

ArrayOfSystem = NDArray[np.float64]

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
    "near_edges_across": LENS,
    "near_edges_down": LENS,
    "columns": SWEEP,
    "stamps": CLOCKS,
}
"""The owner of each error by its name in `confidence.budget`; any other error is the pair's own."""

LASTING = frozenset({"lens_across", "lens_down", "lens_scale"})
"""Errors that a sensor has whatever it sees. The others change with the scene: how far edges of near things, or
columns, lie aside depends on it."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredEdge:
    """An edge or a link that was measured."""

    known: KnownTransform
    T_a_b: Matrix4
    information: ArrayOfSystem  # (6, 6) of the noise
    shared: Mapping[str, ArrayOfSystem]  # (6,) shift by one standard deviation, by owner and name of the error

    @property
    def covariance(self) -> ArrayOfSystem:
        """(6, 6) of all errors; at least as wide as `BUILT` on axes that were not determined."""
        noise = dense.inverse(self.information + np.diag(1.0 / BUILT**2) * 1e-2)
        for name in sorted(self.shared):
            noise = noise + self.shared[name][:, None] * self.shared[name]
        return noise


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The poses (S of (4, 4)), the sum of squares with its degrees of freedom, and the covariance of all edges."""

    poses: tuple[Matrix4, ...]
    chi2: float
    freedom: int
    of_edges: ArrayOfSystem


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
                turned = dense.product(design.T, one.information)
                normal += dense.product(turned, design)
                pull += dense.applied(turned, away)
            step = dense.cholesky_solve(dense.cholesky(normal), pull[:, None])[:, 0]
            poses = tuple(se3.perturb(pose, step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses))
            shared = shared + step[n:]
            if np.abs(step).max() < STILL:
                break
        squares = [float(z) ** 2 for z in shared.tolist()]
        for one in there:
            squares.append(float(dense.squared(one.information, self._linear(one, poses, shared)[1])))
        covariance = dense.inverse(normal)[:n, :n]
        measured_axes = sum(int(np.count_nonzero(one.information.diagonal())) for one in there)
        settled = n - fsum((covariance.diagonal() * prior[:n]).tolist())
        design = np.concatenate([self._design(poses, known.a, known.b) for known in self.graph.known])
        design = design[: 6 * len(self.graph.edges)]
        return Solution(
            poses=poses,
            chi2=fsum(squares),
            freedom=max(round(measured_axes - settled), 0),
            of_edges=dense.product(dense.product(design, covariance), design.T),
        )

    def _linear(
        self, one: MeasuredEdge, poses: Sequence[Matrix4], shared: ArrayOfSystem
    ) -> tuple[ArrayOfSystem, ArrayOfSystem]:
        """The derivative (6, unknowns) of a measurement, and its residual (6,) at some poses."""
        known = one.known
        away = se3.difference(one.T_a_b, self.predicted(poses, known.a, known.b))
        common = np.zeros((6, len(self.errors)))
        for place, name in enumerate(self.errors):
            if name in one.shared:
                common[:, place] = one.shared[name]
        return np.concatenate([self._design(poses, known.a, known.b), common], axis=1), away - dense.applied(
            common, shared
        )

    def _design(self, poses: Sequence[Matrix4], a: str, b: str) -> ArrayOfSystem:
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
    shared: dict[str, ArrayOfSystem] = {}
    for name, shift in window.uncertainty.systematic.items():
        if shift.shape != (6,) or not np.isfinite(shift[determined]).all() or np.abs(shift[determined]).max() > 10.0:
            raise ValueError(f"{known.name}: the error {name} must be a shift of six finite numbers")
        owner = OWNERS.get(name, OWN)
        parts = ((f"{whose(known.a)} {name}", owner.of_a), (f"{whose(known.b)} {name}", owner.of_b))
        if owner is OWN:
            parts = ((f"{known.name} {name}", 1.0), ("", 0.0))
        shared |= {of: part * np.where(determined, shift, 0.0) for of, part in parts if part > 0.0}
    return MeasuredEdge(known, window.T_camera_lidar, information, shared)
