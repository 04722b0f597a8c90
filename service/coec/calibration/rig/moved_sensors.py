"""Who moved? Weighs every set of one or two sensors, and nobody, against the steps of all edges.

If a set S moved by x, each edge that S touches stepped by ξ = J·x + noise, and every other edge by noise alone. Any
edge may also be disturbed by itself; its step is then anywhere within reach. The marginal likelihood of S is a Gaussian
integral over x, summed over which edges were disturbed and over how far mounts move:

    BF(S) = Σ over D, k   w_k · Π over e in D (ε_e · p_disturbed(ξ_e) / p(ξ_e)) · |1 + P_k·Λ|^(-1/2)
                          · exp(½ · ηᵀ·(P_k⁻¹ + Λ)⁻¹·η)        Λ = Σ Jᵀ·W·J, η = Σ Jᵀ·W·ξ over the other edges

relative to nobody moved and no edge disturbed. A set pays for each axis that it sets free (Occam's factor: MacKay 2003,
chapter 28), so the fewest moves that explain all steps win. How far a mount moves follows the prior of mounts: a
Cauchy density in three dimensions is a mixture of normal ones whose scales are MOUNT_RAD over the modulus of a standard
normal variable; a few quantiles stand for all scales.

Two sets can leave the very same pattern on all edges that were looked at, as the camera and the LiDAR of a single pair
do. No evidence tells such sets apart, so they share their probability evenly; the slight preferences that lever arms
and priors would give are ignored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import log, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import normal_quantile
from coec.calibration.monitor.change_detector import ROTATIONS, TRANSLATIONS
from coec.calibration.rig.edge_observations import REACH, EdgeSteps
from coec.calibration.rig.graph import KnownTransform, RigGraph, SensorKind
from coec.calibration.types import MOUNT_RAD
from coec.geometry import linalg, se3

Array = NDArray[np.float64]

SCALES = 4
"""Quantiles that stand for the scales of the mount prior: σ = 0.33, 0.56, 1.0 and 3.2°. A knock of 25° is eight of the
largest, which the next look outweighs."""

M_PER_RAD = TRANSLATIONS.moves[-1][0] / ROTATIONS.moves[-1][0]
"""How far a knock shifts what it turns by one radian, as in the change detector: 10 cm at 2°."""

EVENT_HOURS = 1000.0
"""Hours of driving between two knocks of any kind. Chosen: a fleet's workshop sees a mount bent about once a year."""

SEARCH_SPAN_HOURS = 120.0 / 3600.0
"""How far back a step is looked for: as long as looks are kept apart."""

TWO_SHARE, EDGE_SHARE = 0.1, 0.01
"""Shares of such events that move two sensors, and that lastingly disturb one edge alone (a clock of one driver, a
curtain of spray before one pair). Chosen; the rest move one sensor."""

LINK_BREAKS = 0.01
"""Share of knocks to a bar that bend it. Chosen."""

SEEN = 0.5
"""Good looks since the step from which an edge counts as looked at."""

SAME_SPAN = 1e-6
"""Share of its length by which a pattern may miss the span of others and still lie in it: far above rounding."""

ANY_TWO = log(1e-3)
"""Log odds of any one sensor against nobody from which sets of two are tried: below them, neither of two says
enough."""

CONTENDER = 0.005
"""Probability of a set from which it is compared with others that leave the same pattern."""


@dataclass(frozen=True, slots=True)
class RigidGroup:
    """What moves as one: a sensor, or all sensors on one bar."""

    sensors: tuple[str, ...]


Sets = list[tuple[int, ...]]
"""Movers by their numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """By how much a sensor moved, x (6,) about its own axes (rad, m), and its covariance (6, 6)."""

    x: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class MovePosterior:
    """What is believed of who moved.

    Attributes:
        nobody: probability that nobody moved.
        sets: the sensors of each set with a probability of at least `CONTENDER`, and that probability; likeliest first.
        sensors: probability that each sensor moved, by name.
        disturbed: probability that something other than a sensor lastingly disturbs an edge, by name.
        steps: by how much each sensor in the likeliest set moved, by name.
        when: index of the likeliest time.
        observed: edges that were looked at since.
    """

    nobody: float
    sets: tuple[tuple[tuple[str, ...], float], ...]
    sensors: Mapping[str, float]
    disturbed: Mapping[str, float]
    steps: Mapping[str, Moved]
    when: int
    observed: tuple[str, ...]


def movers(graph: RigGraph) -> tuple[RigidGroup, ...]:
    """Every sensor that can move by itself, and every bar."""
    alone = [RigidGroup((sensor.name,)) for sensor in graph.sensors if sensor.kind is not SensorKind.VEHICLE]
    groups: list[set[str]] = []
    for link in graph.links:
        joined = {link.a, link.b}
        for group in [group for group in groups if group & joined]:
            groups.remove(group)
            joined |= group
        groups.append(joined)
    return (*alone, *(RigidGroup(group) for group in sorted(tuple(sorted(group)) for group in groups)))


def patterns(graph: RigGraph, of: Sequence[RigidGroup]) -> Array:
    """(M, E, 6, 6) how each edge and link, in the order of the graph, steps as each mover moves about the axes of its
    first sensor, at the poses of the graph."""
    poses = dict(zip((sensor.name for sensor in graph.sensors), graph.poses, strict=True))
    return np.array([[_pattern(known, mover, poses) for known in graph.known] for mover in of])


def who_moved(graph: RigGraph, steps: Mapping[str, EdgeSteps]) -> MovePosterior:
    """The posterior over all sets, from what each edge says of a step at each of the same T times. All times are
    equally likely beforehand."""
    rows = _Rows.of(graph, steps)
    moving = movers(graph)
    design = patterns(graph, moving)
    pulls = _Pulls.of(design, rows)
    ones: Sets = [(m,) for m in range(len(moving))]
    twos: Sets = [
        (m, n) for m, n in combinations(range(len(moving)), 2) if not set(moving[m].sensors) & set(moving[n].sensors)
    ]
    alone = 1.0 - TWO_SHARE - EDGE_SHARE
    sets = ones
    log_prior = np.full(len(ones), _log_event() + log(alone / len(ones)))
    log_sets, disturbed = _evidence(ones, rows, pulls)
    log_sets += rows.base[:, None]
    log_nobody = rows.base + rows.either.sum(axis=1) + np.log1p(-np.exp(_log_event()))
    excess = np.logaddexp.reduce((log_prior + log_sets).ravel()) - np.logaddexp.reduce(log_nobody)
    if twos and excess > ANY_TWO:
        # If two moved, one of them alone already says something.
        speaks = log_sets.max(axis=0) > log_nobody.max()
        twos = [(m, n) for m, n in twos if speaks[m] or speaks[n]]
        if twos:
            count = len(ones) * (len(ones) - 1) // 2
            log_twos, disturbed_twos = _evidence(twos, rows, pulls)
            sets = [*ones, *twos]
            log_prior = np.concatenate([log_prior, np.full(len(twos), _log_event() + log(TWO_SHARE / count))])
            log_sets = np.concatenate([log_sets, log_twos + rows.base[:, None]], axis=1)
            disturbed = np.concatenate([disturbed, disturbed_twos], axis=1)
    joint = np.concatenate([log_nobody[:, None], log_prior + log_sets], axis=1)
    weight = np.exp(joint - joint.max())
    weight /= weight.sum()
    shared = _shared(sets, weight[:, 1:].sum(axis=0), design, rows.observed)
    sensors = {sensor.name: 0.0 for sensor in graph.sensors}
    for number, p in enumerate(shared.tolist()):
        for name in _names(moving, sets[number]):
            sensors[name] += p
    lasting = (weight[:, 0, None] * rows.by_itself).sum(axis=0) + (weight[:, 1:, None] * disturbed).sum(axis=(0, 1))
    when = int(np.argmax(weight[:, 1:].sum(axis=1)))
    order = sorted(range(len(sets)), key=lambda number: (-shared[number], number))
    return MovePosterior(
        nobody=float(weight[:, 0].sum()),
        sets=tuple(
            (_names(moving, sets[number]), float(shared[number])) for number in order if shared[number] >= CONTENDER
        ),
        sensors={name: min(p, 1.0) for name, p in sensors.items()},
        disturbed={edge.name: float(p) for edge, p in zip(graph.edges, lasting.tolist(), strict=False)},
        steps=_steps(rows, when, design, sets[order[0]], moving, graph),
        when=when,
        observed=tuple(edge.name for edge, seen in zip(graph.edges, rows.observed.tolist(), strict=False) if seen),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Edges and links, E rows, at T times."""

    xi: Array  # (T, E, 6)
    information: Array  # (T, E, 6, 6) inverse covariance of a step that is noise
    ratio: Array  # (T, E) log density of the step were it disturbed, over that of noise
    log_disturbed: Array  # (T, E) log prior of a disturbance
    lasting: Array  # (T, E) share of that prior that is not a transient
    observed: NDArray[np.bool_]  # (E,) since any of the times
    log_still: Array  # (T, E) log likelihood of all looks at one place, over that of a step by noise alone
    base: Array  # (T,) log likelihood of a step of all edges by noise alone, over that of all at one place

    @property
    def undisturbed(self) -> Array:
        """(T, E) log prior of noise alone."""
        return np.log1p(-np.exp(self.log_disturbed))

    @property
    def bent(self) -> Array:
        """(T, E) log likelihood of a disturbance, with its prior, over that of noise."""
        return self.log_disturbed + self.ratio

    @property
    def either(self) -> Array:
        """(T, E) log likelihood of an edge whose sensors stand still: either noise, such as another street or some bad
        looks, or a disturbance."""
        return np.logaddexp(self.undisturbed + np.logaddexp(0.0, self.log_still) - log(2.0), self.bent)

    @property
    def by_itself(self) -> Array:
        """(T, E) probability that an edge whose sensors stand still is lastingly disturbed."""
        seen = np.abs(self.information).max(axis=(2, 3)) > 0.0
        return np.asarray(np.exp(self.bent - self.either) * self.lasting * seen)

    @classmethod
    def of(cls, graph: RigGraph, steps: Mapping[str, EdgeSteps]) -> _Rows:
        times = len(next(iter(steps.values())).observations) if steps else 1
        xi, covariance, seen, transient, stepped = [], [], [], [], []
        for edge in graph.edges:
            of = steps.get(edge.name)
            xi.append(np.zeros((times, 6)) if of is None else of.xi)
            covariance.append(np.tile(np.eye(6), (times, 1, 1)) if of is None else of.covariance)
            seen.append(np.zeros(times) if of is None else of.observations)
            transient.append(np.zeros(times) if of is None else of.log_transient)
            stepped.append(np.zeros(times) if of is None else of.log_stepped - of.log_still)
        for link in graph.links:
            xi.append(np.zeros((times, 6)))
            covariance.append(np.tile(np.diag(2.0 * link.sigma**2), (times, 1, 1)))
            seen.append(np.ones(times))
            transient.append(np.full(times, -np.inf))
            # No look is at a link: noise alone and no step are the same.
            stepped.append(np.full(times, 3.0 * log(2.0 * pi) + 0.5 * float(np.sum(np.log(2.0 * link.sigma**2)))))
        step, cov = np.stack(xi, axis=1), np.stack(covariance, axis=1)
        observed = np.stack(seen, axis=1) >= SEEN
        # Linearising a move errs by half the square of its turn; for shifts, with lever arms of about a metre.
        angle2 = np.sum(step[..., :3] ** 2, axis=-1)
        cov = cov + (0.5 * angle2[..., None] * np.ones(6))[..., None] ** 2 * np.eye(6)
        factor = linalg.cholesky(cov)
        information = 0.5 * (inverse := linalg.cholesky_solve(factor, np.broadcast_to(np.eye(6), cov.shape)))
        information = np.where(observed[..., None, None], information + 0.5 * np.swapaxes(inverse, -1, -2), 0.0)
        wide = linalg.cholesky(cov + np.diag(REACH**2))
        q = linalg.squared(information, step)
        q_wide = np.sum(step * linalg.cholesky_solve(wide, step[..., None])[..., 0], axis=-1)
        log_volume = linalg.log_determinant(factor)
        spread = linalg.log_determinant(wide) - log_volume
        base = np.stack(stepped, axis=1) - 0.5 * (q + log_volume + 6.0 * log(2.0 * pi))
        base = np.where(observed, base, 0.0)
        edges = len(graph.edges)
        lasting = np.full(step.shape[:2], log(LINK_BREAKS))
        lasting[:, :edges] = _log_event() + log(EDGE_SHARE / max(edges, 1))
        # Without a look since, no transient disturbance is assumed: such an edge speaks neither for nor against
        # anybody.
        for_a_while = np.where(observed, np.stack(transient, axis=1), -np.inf)
        prior = np.minimum(np.logaddexp(lasting, for_a_while), log(0.999))
        return cls(
            xi=step,
            information=information,
            ratio=np.where(observed, 0.5 * (q - q_wide - spread), 0.0),
            log_disturbed=prior,
            lasting=np.exp(np.minimum(lasting - prior, 0.0)),
            observed=np.asarray(observed.any(axis=0)),
            log_still=-base,
            base=base.sum(axis=1),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Pulls:
    """What each edge says of each mover, and of every two movers together: Jᵀ·W·J and Jᵀ·W·ξ."""

    precision: Array  # (T, M, M, E, 6, 6)
    moment: Array  # (T, M, E, 6)
    touched: NDArray[np.bool_]  # (M, E) whether a move of the mover displaces the edge, and the edge was looked at

    @classmethod
    def of(cls, design: Array, rows: _Rows) -> _Pulls:
        turned = linalg.product(np.swapaxes(design, -1, -2), rows.information[:, None])  # (T, M, E, 6, 6)
        return cls(
            precision=linalg.product(turned[:, :, None], design[None, None]),
            moment=linalg.applied(turned, rows.xi[:, None]),
            touched=(np.abs(design).max(axis=(2, 3)) > 0.0) & rows.observed,
        )

    def together(self, sets: Sequence[tuple[int, ...]]) -> tuple[Array, Array]:
        """Precision (T, S, E, 6n, 6n) and moment (T, S, E, 6n) for S sets of the same size n."""
        times, edges, size = self.moment.shape[0], self.moment.shape[2], 6 * len(sets[0])
        precision = np.zeros((times, len(sets), edges, size, size))
        moment = np.zeros((times, len(sets), edges, size))
        for place, one in enumerate(sets):
            for i, m in enumerate(one):
                moment[:, place, :, 6 * i : 6 * i + 6] = self.moment[:, m]
                for j, n in enumerate(one):
                    precision[:, place, :, 6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = self.precision[:, m, n]
        return precision, moment


def _evidence(sets: Sets, rows: _Rows, pulls: _Pulls) -> tuple[Array, Array]:
    """For sets of the same size, at each time: the log marginal likelihood (T, S) over that of nobody moved and nothing
    disturbed, and the probability that each edge is lastingly disturbed (T, S, E).

    Of the edges that a set touches, these cases count: none is disturbed; one is; the likeliest one and one more are.
    """
    precision, moment = pulls.together(sets)
    times, edges = rows.ratio.shape
    touched = np.array([pulls.touched[list(one)].any(axis=0) for one in sets])
    cases: list[tuple[int, tuple[int, ...]]] = [(place, ()) for place in range(len(sets))]
    cases += [(place, (e,)) for place in range(len(sets)) for e in np.flatnonzero(touched[place]).tolist()]
    cases_of_sets: list[list[_Case]] = [[] for _ in sets]
    for (place, out), log_evidence in zip(cases, _marginal(cases, precision, moment, rows, touched).T, strict=True):
        cases_of_sets[place].append(_Case(out, log_evidence))
    cases = []
    for place, of_set in enumerate(cases_of_sets):
        if len(of_set) < 4:  # if both of two edges are disturbed, nothing speaks for the set
            continue
        worst = max(of_set[1:], key=lambda case: float(case.log_evidence.max())).out[0]
        cases += [(place, (worst, *case.out)) for case in of_set[1:] if case.out[0] != worst]
    for (place, out), log_evidence in zip(cases, _marginal(cases, precision, moment, rows, touched).T, strict=True):
        cases_of_sets[place].append(_Case(out, log_evidence))
    log_sets, disturbed = np.zeros((times, len(sets))), np.zeros((times, len(sets), edges))
    for place, of_set in enumerate(cases_of_sets):
        each = np.array([case.log_evidence for case in of_set])  # (C, T)
        total = np.logaddexp.reduce(each, axis=0)
        share = np.exp(each - total)
        log_sets[:, place] = total + rows.either[:, ~touched[place]].sum(axis=1)
        disturbed[:, place] = np.where(touched[place], 0.0, rows.by_itself)
        for case, of_case in zip(of_set, share, strict=True):
            for e in case.out:
                disturbed[:, place, e] += of_case * rows.lasting[:, e]
    return log_sets, disturbed


class _Case(NamedTuple):
    """Which of the edges that a set touches are disturbed, and the log evidence (T,) of that."""

    out: tuple[int, ...]
    log_evidence: Array


def _marginal(
    cases: Sequence[tuple[int, tuple[int, ...]]],
    precision: Array,
    moment: Array,
    rows: _Rows,
    touched: NDArray[np.bool_],
) -> Array:
    """(T, C) log evidence of each case at each time. A case is the number of a set and the edges that are disturbed."""
    if not cases:
        return np.zeros((len(rows.xi), 0))
    places = [place for place, _ in cases]
    total, pull = precision.sum(axis=2)[:, places], moment.sum(axis=2)[:, places]
    constant = np.stack([rows.undisturbed[:, touched[place]].sum(axis=1) for place in places], axis=1)
    for row, (place, out) in enumerate(cases):
        for e in out:
            total[:, row] -= precision[:, place, e]
            pull[:, row] -= moment[:, place, e]
            constant[:, row] += rows.bent[:, e] - rows.undisturbed[:, e]
    size = total.shape[-1]
    # Scaled by the prior: 1 + P^½·Λ·P^½ has eigenvalues of 1 or more.
    root = np.sqrt(np.array([np.tile(variance, size // 6) for variance in _variances()]))[:, None, None]
    factor = linalg.cholesky(np.eye(size) + total * root[..., :, None] * root[..., None, :])
    scaled = pull * root
    explained = np.sum(scaled * linalg.cholesky_solve(factor, scaled[..., None])[..., 0], axis=-1)
    by_scale = 0.5 * (explained - linalg.log_determinant(factor))
    return np.asarray(constant + np.logaddexp.reduce(by_scale, axis=0) - log(SCALES))


def _variances() -> list[Array]:
    """(6,) variances of a move, for each scale of the mount prior."""
    scales = [MOUNT_RAD / normal_quantile(0.5 + 0.5 * (k + 0.5) / SCALES) for k in range(SCALES)]
    return [np.array([s] * 3 + [s * M_PER_RAD] * 3) ** 2 for s in scales]


def _log_event() -> float:
    return log(SEARCH_SPAN_HOURS / EVENT_HOURS)


def _names(moving: Sequence[RigidGroup], one: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(sorted(name for m in one for name in moving[m].sensors))


def _pattern(known: KnownTransform, mover: RigidGroup, poses: Mapping[str, Array]) -> Array:
    origin = se3.inverse(poses[mover.sensors[0]])
    a_moves, b_moves = known.a in mover.sensors, known.b in mover.sensors
    if a_moves == b_moves:  # a bar that moves as a whole does not change what lies between its ends
        return np.zeros((6, 6))
    if a_moves:
        return se3.adjoint(poses[known.a] @ origin)
    return -se3.adjoint(known.T_a_b @ poses[known.b] @ origin)


def _shared(sets: Sequence[tuple[int, ...]], probability: Array, design: Array, observed: NDArray[np.bool_]) -> Array:
    """(S,) the probabilities; sets that leave the same pattern pool theirs, shared evenly by the smallest of them."""
    contenders = [number for number in range(len(sets)) if probability[number] >= CONTENDER]
    moves_row = np.abs(design).max(axis=(2, 3)) > 0.0
    # Sets that leave the same pattern touch the same edges, so few are left to compare.
    touched = [tuple((moves_row[list(one)].any(axis=0) & observed).tolist()) for one in sets]
    shared, done = probability.copy(), set[int]()
    for number in contenders:
        if number in done:
            continue
        span = _span(sets[number], design, observed)
        others = [other for other in range(len(sets)) if touched[other] == touched[number]]
        alike = [other for other in others if other == number or _same(span, _span(sets[other], design, observed))]
        done.update(alike)
        fewest = min(len(sets[other]) for other in alike)
        smallest = [other for other in alike if len(sets[other]) == fewest]
        shared[alike] = 0.0
        shared[smallest] = float(probability[alike].sum()) / len(smallest)
    return shared


def _span(one: tuple[int, ...], design: Array, observed: NDArray[np.bool_]) -> Array:
    """(R, n) an orthonormal basis of the patterns that a set leaves on the edges looked at (Gram, Schmidt)."""
    columns = np.concatenate([design[m][observed].reshape(-1, 6) for m in one], axis=1)
    basis: list[Array] = []
    for column in columns.T:
        length = float(np.sqrt(np.sum(column * column)))
        rest = column.copy()
        for _ in range(2):  # once more for what rounding left
            for of in basis:
                rest = rest - of * np.sum(of * rest)
        left = float(np.sqrt(np.sum(rest * rest)))
        if left > SAME_SPAN * max(length, 1.0):
            basis.append(rest / left)
    return np.array(basis).reshape(len(basis), -1).T


def _same(one: Array, other: Array) -> bool:
    """Whether two bases span the same space."""
    if one.shape != other.shape:
        return False
    missed = other - linalg.product(one, linalg.product(one.T, other))
    return bool(np.abs(missed).max() < 100.0 * SAME_SPAN)


def _steps(
    rows: _Rows, t: int, design: Array, one: tuple[int, ...], moving: Sequence[RigidGroup], graph: RigGraph
) -> dict[str, Moved]:
    """By how much each sensor of a set moved, if the set did. Edges that do not fit count less, as in a mixture."""
    size, variance = 6 * len(one), np.tile(_variances()[0], len(one))
    columns = np.concatenate([design[m] for m in one], axis=2)  # (E, 6, size)
    weight = np.ones(columns.shape[0])
    x, covariance = np.zeros(size), np.diag(variance)
    for _ in range(5):
        information = np.diag(1.0 / variance)
        pull = np.zeros(size)
        for e in range(columns.shape[0]):
            turned = weight[e] * linalg.product(columns[e].T, rows.information[t, e])
            information = information + linalg.product(turned, columns[e])
            pull = pull + linalg.applied(turned, rows.xi[t, e])
        covariance = linalg.inverse(information)
        x = linalg.applied(covariance, pull)
        away = rows.xi[t] - linalg.applied(columns, x)
        q = linalg.squared(rows.information[t], away)
        whole = linalg.squared(rows.information[t], rows.xi[t])
        # Odds of a disturbance by itself against noise about the move.
        log_odds = rows.log_disturbed[t] + rows.ratio[t] - 0.5 * whole + 0.5 * q
        weight = 1.0 / (1.0 + np.exp(np.clip(log_odds, -50.0, 50.0)))
    poses = dict(zip((sensor.name for sensor in graph.sensors), graph.poses, strict=True))
    moved = {}
    for i, m in enumerate(one):
        of = slice(6 * i, 6 * i + 6)
        first = se3.inverse(poses[moving[m].sensors[0]])
        for name in moving[m].sensors:
            carried = se3.adjoint(poses[name] @ first)
            moved[name] = Moved(
                linalg.applied(carried, x[of]), linalg.product(linalg.product(carried, covariance[of, of]), carried.T)
            )
    return moved
