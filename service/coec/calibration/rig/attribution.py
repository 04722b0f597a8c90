"""What several pairs of one vehicle together say about each of its sensors, look after look.

A knocked LiDAR moves the edges to all its cameras alike; a knocked camera moves only its own. Every few seconds the
question which sensors moved since the rig was last consistent is asked again (`who_moved`), about steps at several
times in the past (`steps_at`).

A sensor is named (reported as moved) by two answers in a row, each of which knows of a new look at the sensor, and by
looks at two of its pairs if it has as many. A run of bad looks at one pair, or one pair that was looked at before the
others, is denied by the next look. An accepted window is independent evidence: with it one answer suffices.

Looks alone never name a sensor all of whose pairs are with sensors that also seem to have moved. All that speaks for
such a sensor is that its pair steps otherwise than the rest, and so does a pair whose looks at a knocked mount are
bent. So if the one LiDAR of a vehicle seems to have moved, a window decides whether a camera moved beside it.
"""

from bisect import bisect_left
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import degrees

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import chi2_quantile
from coec.calibration.rig.edge_observations import EdgeHistory, EdgeObservation, steps_at
from coec.calibration.rig.graph import Edge, RigGraph, Sensor, SensorKind
from coec.calibration.rig.moved_sensors import SEEN, Moved, MovePosterior, who_moved
from coec.calibration.types import NS_PER_S, Matrix4, Reason
from coec.geometry import linalg

NAMED_AT = 0.95
"""A sensor that is at least so probable to have moved may be named; one below the complement is called calibrated.
Between them it is undecided."""

ANSWERS = 2
"""How many answers in a row name a sensor."""

LIKELY_AT = 0.5
"""Probability from which a window confirms that a camera moved beside its LiDAR. See docs/measured.md."""

CALM_AT = 0.5
"""Probability that nobody moved, from which looks that grow old count as looks at a right rig."""

NEWEST = 6
"""How many of the edges' last looks are used, newest first: a step is tried right after each of them, because just
after a LiDAR is knocked some of its edges show it already, and others were last looked at before."""

AGES_S = (10.0, 16.0, 26.0, 42.0, 68.0, 110.0)
"""How long ago a step is looked for otherwise, at intervals that a robust mean bridges; and beyond these, before all
looks that are kept."""

MOST_SUSPECTED = 4
"""How many of the times at which pairs themselves suspect a step are tried, earliest first: the pairs of a sensor that
moves suspect it within a few looks."""

STEPPED2 = chi2_quantile(0.999, 6)
"""Squared distance in standard deviations from which an edge counts as stepped: one in a thousand does so by chance."""

POOREST = 3.0
"""A poor street displaces all observations by up to so many standard deviations of usual streets
(`dispersion`). See docs/measured.md."""

EVERY_S = 4.0
"""Least time between two answers to who moved: one takes 0.03 to 0.1 s of a core, and looks come faster than they
matter."""

BEFORE_ALL_NS = -(2**62)
"""A stamp before any other."""


class SensorHealth(StrEnum):
    """The state of one sensor. `undecided`: something moved or is disturbed, and it may be this sensor; `unknown`: no
    look at it yet."""

    CALIBRATED = "calibrated"
    CAMERA_MOVED = "camera_moved"
    LIDAR_MOVED = "lidar_moved"
    UNDECIDED = "undecided"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, eq=False)
class SensorState:
    """What is believed of one sensor.

    Attributes:
        probability: that it moved.
        moved: by how much it moved, if it is in the likeliest set of sensors that moved.
        reasons: why, in words; the first one says most.
    """

    name: str
    kind: SensorKind
    health: SensorHealth
    probability: float
    moved: Moved | None
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """All that is kept between looks.

    Attributes:
        histories: of every edge, by name.
        posterior: the last answer to who moved; None before the first look.
        attributed_ns: stamp of the look after which who moved was last asked; a window does not change it.
        stepped_ns: the step in question lies before the looks from this stamp on.
        claimed: the sensors that are probable enough to be named, each with the number of answers in a row that said so
            and knew of a new look at it, `ANSWERS` at most.
        named: the sensors that moved.
    """

    histories: Mapping[str, EdgeHistory]
    posterior: MovePosterior | None = None
    attributed_ns: int = BEFORE_ALL_NS
    stepped_ns: int = BEFORE_ALL_NS
    claimed: Mapping[str, int] = field(default_factory=dict)
    named: frozenset[str] = frozenset()

    @property
    def calm(self) -> bool:
        """Whether all looks up to now fit a right rig."""
        of = self.posterior
        return of is None or (of.nobody >= CALM_AT and all(p < CALM_AT for p in of.disturbed.values()))


def initial(graph: RigGraph) -> RigState:
    """The state before any look: every edge is as the vehicle was built, with unknown uncertainty."""
    return RigState({edge.name: EdgeHistory.at(edge.T_a_b, np.full(6, np.nan)) for edge in graph.edges})


def served(state: RigState, edge: str, T_a_b: Matrix4, sigma: NDArray[np.float64]) -> RigState:
    """The state after a new pose (4, 4), known to `sigma` (6,), is served for an edge. Steps of the edge are counted
    from this pose. Earlier looks at the edge are of another mount and are forgotten.

    Raises:
        ValueError: there is no such edge.
    """
    if edge not in state.histories:
        raise ValueError(f"{edge}: not an edge of this rig; its edges are {', '.join(sorted(state.histories))}")
    return replace(state, histories={**state.histories, edge: EdgeHistory.served(T_a_b, sigma)})


def settled(state: RigState) -> RigState:
    """The state after an event is over, because what is served now accounts for it: the next look asks anew who
    moved."""
    return RigState(state.histories)


def stepped(state: RigState) -> tuple[str, ...]:
    """The edges that lie elsewhere since `stepped_ns` than before, by more than chance."""
    return tuple(
        name
        for name, history in state.histories.items()
        if history.all_observations and _stepped(history, state.stepped_ns)
    )


def after_edge_observation(state: RigState, graph: RigGraph, observation: EdgeObservation) -> RigState:
    """The state after one more look.

    Raises:
        ValueError: it is of no edge of the rig.
    """
    state = _with(state, observation)
    if observation.stamp_ns - state.attributed_ns < EVERY_S * NS_PER_S:
        return state
    return replace(_with_attribution(state, graph, None), attributed_ns=observation.stamp_ns)


def after_window(state: RigState, graph: RigGraph, observation: EdgeObservation) -> RigState:
    """The state after an accepted window, given as a look at the stamp of its first frame.

    Who moved is asked at once, because the pair may serve the window's pose from now on, and after that the question is
    no longer asked. If the window begins after the step, its one answer is enough to name a sensor of its edge. A
    camera whose LiDAR also seems to have moved is named only if the window says so by itself (`_likely_by`).

    Raises:
        ValueError: it is of no edge of the rig.
    """
    return _with_attribution(_with(state, observation), graph, observation)


def _with(state: RigState, observation: EdgeObservation) -> RigState:
    """The state with one more look, before anybody asks who moved."""
    if observation.edge not in state.histories:
        raise ValueError(
            f"{observation.edge}: not an edge of this rig; its edges are {', '.join(sorted(state.histories))}"
        )
    history = state.histories[observation.edge].after(observation, state.calm)
    return replace(state, histories={**state.histories, observation.edge: history})


def _with_attribution(state: RigState, graph: RigGraph, window: EdgeObservation | None) -> RigState:
    """The state after asking who moved, by all looks. `window` is the look of an accepted window among them, if the
    window is the reason to ask."""
    histories = state.histories
    times_ns = _times_ns(histories, state.stepped_ns)
    posterior = _posterior(histories, times_ns, graph)
    stepped_ns = times_ns[posterior.when]
    probable = _probable(posterior)
    hidden = {name for name in probable if _is_hidden(name, probable, graph)}
    confirmed: set[str] = set()
    if window is not None and window.stamp_ns >= stepped_ns:  # a window of earlier frames is of another mount
        ends = {graph.edge[window.edge].a, graph.edge[window.edge].b}
        doubted = ends & hidden
        confirmed = ends - doubted
        if doubted:
            confirmed |= doubted & _likely_by(window, histories, times_ns, stepped_ns, graph)
    claimed = {
        name: ANSWERS if name in confirmed else min(state.claimed.get(name, 0) + _is_news(name, graph, state), ANSWERS)
        for name in probable
        if name in confirmed or name in state.named or _is_observed_enough(name, graph, histories, stepped_ns)
    }
    return replace(
        state,
        posterior=posterior,
        stepped_ns=stepped_ns,
        claimed=claimed,
        named=frozenset(
            name
            for name, count in claimed.items()
            if name in state.named or (name in confirmed if name in hidden else count >= ANSWERS)
        ),
    )


def _likely_by(
    window: EdgeObservation, histories: Mapping[str, EdgeHistory], times_ns: list[int], stepped_ns: int, graph: RigGraph
) -> set[str]:
    """The sensors that likely moved if an accepted window replaces all looks at its edge since `stepped_ns`. Those
    looks may all be bent alike, or come from a poor street; the window is independent evidence, with its own search."""
    history = histories[window.edge]
    observations = tuple(
        observation
        for observation in history.observations
        if observation.stamp_ns < stepped_ns or observation is window
    )
    by_window = _posterior({**histories, window.edge: replace(history, observations=observations)}, times_ns, graph)
    return {name for name, p in by_window.sensors.items() if p >= LIKELY_AT}


def _probable(of: MovePosterior) -> tuple[str, ...]:
    """The sensors that are probable enough to be named."""
    return tuple(name for name, p in of.sensors.items() if p >= NAMED_AT)


def _is_hidden(name: str, probable: Collection[str], graph: RigGraph) -> bool:
    """Whether every pair of a sensor is with another sensor that may be named."""
    far_ends = {edge.b if edge.a == name else edge.a for edge in graph.edges if name in (edge.a, edge.b)}
    return far_ends <= set(probable)


def _is_news(name: str, graph: RigGraph, state: RigState) -> bool:
    """Whether a pair of a sensor was looked at since the last answer. Without this, one bad look could count in several
    answers while other pairs show other sensors."""
    pairs = (state.histories[edge.name].observations for edge in graph.edges if name in (edge.a, edge.b))
    return any(observations[-1].stamp_ns > state.attributed_ns for observations in pairs if observations)


def _is_observed_enough(name: str, graph: RigGraph, histories: Mapping[str, EdgeHistory], since_ns: int) -> bool:
    """Whether enough was seen of a sensor since a stamp to name it.

    If it has several pairs, two of them must have been looked at: a single one may have a fault of its own, such as the
    clock of one driver, which another pair would deny. If it has one pair, nothing else tells a small move from a
    street that bends all looks a little. That pair must then suspect a move by itself, or have stepped farther than
    such a street bends looks.
    """
    of_pairs = [histories[edge.name] for edge in graph.edges if name in (edge.a, edge.b)]
    if len(of_pairs) > 1:
        return sum(bool(of.observations) and of.observations[-1].stamp_ns >= since_ns for of in of_pairs) >= 2
    (history,) = of_pairs
    clear = [
        observation for observation in history.observations if observation.stamp_ns >= since_ns and not observation.weak
    ]
    return bool(clear) and (clear[-1].stepped_ns is not None or _stepped(history, since_ns, POOREST))


def _stepped(history: EdgeHistory, since_ns: int, place_times: float = 1.0) -> bool:
    """Whether an edge lies elsewhere since a stamp than before, by more than chance, if streets scatter its looks by
    `place_times` their usual standard deviation."""
    step = steps_at(history, [since_ns], place_times)
    distance2 = float(linalg.squared(linalg.inverse(step.covariance[0]), step.xi[0]))
    return bool(step.observations[0] >= SEEN and distance2 > STEPPED2)


def _times_ns(histories: Mapping[str, EdgeHistory], stepped_ns: int) -> list[int]:
    """The stamps to try, newest first: the looks from each on may lie after a step. Times with no look between them are
    one. The likeliest time of the last answer, `stepped_ns`, and the times since which pairs suspect themselves are
    included because, unlike ages, they do not drift as looks grow old."""
    observed = [history.all_observations for history in histories.values() if history.all_observations]
    last_ns = sorted({observations[-1].stamp_ns for observations in observed}, reverse=True)
    aged_ns = [last_ns[0] - round(age_s * NS_PER_S) for age_s in AGES_S]
    just_after = (stamp_ns + 1 for stamp_ns in last_ns[1:NEWEST])
    latest = [history.observations[-1].stepped_ns for history in histories.values() if history.observations]
    suspected = sorted({stamp_ns for stamp_ns in latest if stamp_ns is not None})[:MOST_SUSPECTED]
    all_ns = sorted({observation.stamp_ns for observations in observed for observation in observations})
    first_after = (bisect_left(all_ns, at_ns) for at_ns in (*just_after, *aged_ns, stepped_ns, *suspected))
    # The stamp of the very first look is the same as before all looks.
    candidates_ns = {all_ns[place] for place in first_after if 0 < place < len(all_ns)}
    return sorted({last_ns[0], *candidates_ns, BEFORE_ALL_NS}, reverse=True)


def _posterior(histories: Mapping[str, EdgeHistory], times_ns: list[int], graph: RigGraph) -> MovePosterior:
    # Levers and axes as they were before the step, because the rig may be far from how it was built.
    edges = [Edge(edge.name, edge.a, edge.b, histories[edge.name].pose) for edge in graph.edges]
    current = RigGraph.of(graph.sensors, edges, graph.links)
    return who_moved(current, {name: steps_at(history, times_ns) for name, history in histories.items()})


def sensors(state: RigState, graph: RigGraph) -> tuple[SensorState, ...]:
    """What is believed of every sensor that can move, by name."""
    return tuple(_state(state, graph, sensor) for sensor in graph.sensors if sensor.kind is not SensorKind.VEHICLE)


def _state(state: RigState, graph: RigGraph, sensor: Sensor) -> SensorState:
    edges = [edge.name for edge in graph.edges if sensor.name in (edge.a, edge.b)]
    observed = [name for name in edges if state.histories[name].observations]
    of = state.posterior
    if of is None and sensor.name in state.named:
        text = "It had moved when the service was stopped; none of its pairs has been checked since."
        return SensorState(sensor.name, sensor.kind, _moved(sensor), 1.0, None, (Reason("last_known", text),))
    if of is None or not observed:
        text = "None of its pairs has been checked yet." if edges else "It is in no pair, so its pose is not measured."
        return SensorState(sensor.name, sensor.kind, SensorHealth.UNKNOWN, 0.0, None, (Reason("not_looked_at", text),))
    probability = of.sensors[sensor.name]
    disturbed = max((of.disturbed[name] for name in edges), default=0.0)
    moved = of.steps.get(sensor.name) if probability > 1.0 - NAMED_AT else None
    if sensor.name in state.named:
        health = _moved(sensor)
        reasons: tuple[Reason, ...] = (_named(sensor, probability, moved, observed, of),)
    elif max(probability, disturbed) > 1.0 - NAMED_AT:
        health, reasons = SensorHealth.UNDECIDED, _undecided(sensor, probability, disturbed, edges, of)
        if probability >= NAMED_AT:
            decides = (
                "a window of its pairs decides"
                if _is_hidden(sensor.name, _probable(of), graph)
                else "the next checks decide"
            )
            text = f"It has probably moved ({100.0 * probability:.1f} %); {decides}."
            reasons = (Reason("one_more_look", text), *reasons[1:])
    else:
        health = SensorHealth.CALIBRATED
        text = f"The checked pairs fit without a move of this sensor: {', '.join(observed)}."
        reasons = (Reason("fits", text),)
    return SensorState(sensor.name, sensor.kind, health, probability, moved, reasons)


def _moved(sensor: Sensor) -> SensorHealth:
    return SensorHealth.CAMERA_MOVED if sensor.kind is SensorKind.CAMERA else SensorHealth.LIDAR_MOVED


def _named(sensor: Sensor, probability: float, moved: Moved | None, observed: list[str], of: MovePosterior) -> Reason:
    since = [name for name in observed if name in of.observed]
    far = "" if moved is None else f" by {_size(moved)}"
    others = [name for name in of.sets[0][0] if name != sensor.name]
    others_text = f", together with {', '.join(others)}" if others else ""
    text = f"It moved{far}{others_text}: measured by {', '.join(since)}; all else fits ({100.0 * probability:.1f} %)."
    return Reason("moved", text)


def _undecided(
    sensor: Sensor, probability: float, disturbed: float, edges: list[str], of: MovePosterior
) -> tuple[Reason, ...]:
    reasons = []
    if probability > 1.0 - NAMED_AT:
        rivals = [" and ".join(names) for names, _ in of.sets if sensor.name not in names][:3]
        or_else = f" or {', or '.join(rivals)}" if rivals else ", or nothing did"
        text = f"It moved{or_else}: the checked pairs cannot distinguish ({100.0 * probability:.0f} %)."
        reasons.append(Reason("cannot_tell", text))
    if disturbed > 1.0 - NAMED_AT:
        pair = max(edges, key=lambda name: of.disturbed[name])
        text = f"{pair} does not fit, and other pairs exclude a move of a sensor: {100.0 * disturbed:.0f} %."
        reasons.append(Reason("pair_disturbed", text))
    return tuple(reasons)


def _size(moved: Moved) -> str:
    turn = degrees(float(np.sqrt(np.sum(moved.x[:3] ** 2))))
    shift_cm = 100.0 * float(np.sqrt(np.sum(moved.x[3:] ** 2)))
    return f"{turn:.2f}° and {shift_cm:.1f} cm"
