"""What several pairs of one vehicle say together of each of its sensors, look after look.

A knocked LiDAR moves the edges to all its cameras alike, a knocked camera its own alone: which sensors moved since the
rig was last consistent is asked again every few seconds (`moves`), of steps at some times back (`steps`).

A sensor is named by two answers in a row, with a look in between, and by two of its pairs where it has as many: what a
run of bad looks says of one pair, or one pair that was looked at before the others, the next look denies. Where two
sensors are said to have moved at once it takes one answer more, for each: a bad look at one pair just after a sensor of
many was knocked makes its other sensor seem to have moved as well. An accepted window is a witness of another kind:
with it one answer suffices. And looks alone name no sensor whose every pair is with one that seems to have moved, too:
all that speaks for it is that its pair steps otherwise than the rest, as a pair does whose looks at a knocked mount are
bent. Of a camera beside the one LiDAR of a vehicle a window decides.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import degrees

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.quantiles import chi2_quantile
from coec.calibration.rig.evidence import BIAS_TIMES, Look
from coec.calibration.rig.moves import SEEN, Moved, Posterior, who_moved
from coec.calibration.rig.steps import History, steps_at
from coec.calibration.rig.types import Edge, Kind, RigGraph, Sensor
from coec.calibration.types import Matrix4, Reason
from coec.geometry import dense

NAMED_AT = 0.95
"""Probability from which a sensor is named, if it was before, and below whose complement it is called calibrated.
Between: undecided."""

ANSWERS = 2
"""In a row, that name a sensor."""

LIKELY_AT = 0.5
"""Probability from which a window confirms that a camera moved beside its LiDAR. Where looks at a camera were bent and
its LiDAR alone was knocked, windows of drawn rigs say 0.01 to 0.1."""

CALM_AT = 0.5
"""Probability of nobody, from which looks that grow old are taken for such of a right rig."""

NEWEST = 6
"""Looks, the last of each edge, after each of which a step is looked for: of a LiDAR that was just knocked some edges
tell already, and others were last looked at before."""

AGES_S = (10.0, 16.0, 26.0, 42.0, 68.0, 110.0)
"""How long ago it is looked for otherwise, in steps that a robust mean bridges; and beyond these, before all looks that
are kept."""

MOST_SUSPECTED = 4
"""Times at which pairs by themselves think they stepped that are asked of, the earliest: a sensor that moves is
suspected by its pairs within a few looks."""

STEPPED2 = chi2_quantile(0.999, 6)
"""Squared distance in standard deviations, from which an edge has stepped: one in a thousand does so by chance."""

POOREST = 3.0
"""Times the scatter of streets that looks of a poor one are off by, all alike: those at right mounts with the faintest
contrast lie 2.6 of its standard deviations off (`monitor.dispersion`)."""

EVERY_S = 4.0
"""Between two times that it is asked who moved: it takes 0.03 to 0.1 s of a core, and looks come faster than they
matter."""

NS_PER_S = 1_000_000_000
BEFORE_ALL_NS = -(2**62)
"""A stamp before any other."""


class SensorHealth(StrEnum):
    """Of one sensor. `undecided`: something moved or is disturbed, and this may be it; `unknown`: nothing looked."""

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
        moved: by how much, if it is in the likeliest set that moved.
        reasons: why, in words; the first one says most.
    """

    name: str
    kind: Kind
    health: SensorHealth
    probability: float
    moved: Moved | None
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """All that is kept between looks.

    Attributes:
        histories: of every edge, by name.
        posterior: who moved, as of when that was last asked; None before the first look.
        asked_ns: stamp of the look at which it was.
        stepped_ns: the step in question lies before looks from this stamp on.
        claimed: sensors as probable as those that are named, and by how many answers in a row that know of a new look
            at them, no more than count.
        named: those that moved.
    """

    histories: Mapping[str, History]
    posterior: Posterior | None = None
    asked_ns: int = BEFORE_ALL_NS
    stepped_ns: int = BEFORE_ALL_NS
    claimed: Mapping[str, int] = field(default_factory=dict)
    named: frozenset[str] = frozenset()

    @property
    def calm(self) -> bool:
        """Whether all looks up to now are those of a right rig."""
        of = self.posterior
        return of is None or (of.nobody >= CALM_AT and all(p < CALM_AT for p in of.disturbed.values()))


def begun(graph: RigGraph) -> RigState:
    """Nothing was looked at: every edge is as the vehicle was built, as far as that is known."""
    return RigState({edge.name: History.at(edge.T_a_b, np.full(6, np.nan)) for edge in graph.edges})


def served(state: RigState, edge: str, T_a_b: Matrix4, sigma: NDArray[np.float64]) -> RigState:
    """A new pose (4, 4) is served for an edge, known to `sigma` (6,): steps of it are counted from there. Looks before
    are of another mount, and are forgotten.

    Raises:
        ValueError: there is no such edge.
    """
    if edge not in state.histories:
        raise ValueError(f"{edge}: no edge of this rig, it has {', '.join(sorted(state.histories))}")
    return replace(state, histories={**state.histories, edge: History.at(T_a_b, sigma)})


def settled(state: RigState) -> RigState:
    """What was in question is answered for by what is served now: who moved is asked anew with the next look."""
    return RigState(state.histories)


def stepped(state: RigState) -> tuple[str, ...]:
    """Edges that lie elsewhere than before `stepped_ns`, by more than chance."""
    return tuple(
        name for name, history in state.histories.items() if history.looks and _stepped(history, state.stepped_ns)
    )


def after_look(state: RigState, graph: RigGraph, look: Look) -> RigState:
    """The state after one more look.

    Raises:
        ValueError: it is of no edge of the rig.
    """
    state = _with(state, look)
    if look.stamp_ns - state.asked_ns < EVERY_S * NS_PER_S:
        return state
    return replace(_asked(state, graph, None), asked_ns=look.stamp_ns)


def after_window(state: RigState, graph: RigGraph, look: Look) -> RigState:
    """The state after an accepted window, as a look at the stamp of its first frame: who moved is asked at once, as the
    pair may serve what it says from now on, and who moved then is asked no more. If it is of after the step, its answer
    counts for as many as name a sensor of its edge; a camera whose LiDAR moved as well it has to name by itself.

    Raises:
        ValueError: it is of no edge of the rig.
    """
    return _asked(_with(state, look), graph, look)


def _with(state: RigState, look: Look) -> RigState:
    """The state with one more look, of which nobody was asked."""
    if look.edge not in state.histories:
        raise ValueError(f"{look.edge}: no edge of this rig, it has {', '.join(sorted(state.histories))}")
    history = state.histories[look.edge]
    if not history.looks:
        # Whoever looks has a bias of its own on this rig, however well the pose is known that is served.
        history = History.at(history.origin, np.hypot(np.nan_to_num(history.sigma), BIAS_TIMES * look.rig))
    return replace(state, histories={**state.histories, look.edge: history.after(look, state.calm)})


def _asked(state: RigState, graph: RigGraph, window: Look | None) -> RigState:
    """Who moved, by all looks? `window` is what an accepted one says that is among them, if that is why it is asked."""
    histories = state.histories
    times_ns = _times_ns(histories, state.stepped_ns)
    posterior = _posterior(histories, times_ns, graph)
    stepped_ns = times_ns[posterior.when]
    probable = _probable(posterior)
    hidden = {name for name in probable if _is_hidden(name, probable, graph)}
    confirmed: set[str] = set()
    if window is not None and window.stamp_ns >= stepped_ns:  # one of frames before tells of another mount
        ends = {graph.edge[window.edge].a, graph.edge[window.edge].b}
        doubted = ends & hidden
        confirmed = ends - doubted
        if doubted:
            confirmed |= doubted & _likely_by(window, histories, times_ns, stepped_ns, graph)
    claimed = {
        name: ANSWERS if name in confirmed else min(state.claimed.get(name, 0) + _is_news(name, graph, state), ANSWERS)
        for name in probable
        if name in confirmed or name in state.named or _is_witnessed(name, graph, histories, stepped_ns)
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
    window: Look, histories: Mapping[str, History], times_ns: list[int], stepped_ns: int, graph: RigGraph
) -> set[str]:
    """The sensors that likely moved by an accepted window in place of all looks at its edge since a stamp: these may be
    bent alike, or of a poor street; it is another witness, with a search of its own."""
    history = histories[window.edge]
    looks = tuple(look for look in history.looks if look.stamp_ns < stepped_ns or look is window)
    by_window = _posterior({**histories, window.edge: replace(history, looks=looks)}, times_ns, graph)
    return {name for name, p in by_window.sensors.items() if p >= LIKELY_AT}


def _probable(of: Posterior) -> tuple[str, ...]:
    """Sensors that may be named."""
    return tuple(name for name, p in of.sensors.items() if p >= NAMED_AT)


def _is_hidden(name: str, probable: Collection[str], graph: RigGraph) -> bool:
    """Whether every pair of a sensor is with another that may be named."""
    far_ends = {edge.b if edge.a == name else edge.a for edge in graph.edges if name in (edge.a, edge.b)}
    return far_ends <= set(probable)


def _is_news(name: str, graph: RigGraph, state: RigState) -> bool:
    """Whether a pair of a sensor was looked at since who moved was last asked. A bad look does not become a better one
    by what other pairs show of other sensors meanwhile."""
    pairs = (state.histories[edge.name].looks for edge in graph.edges if name in (edge.a, edge.b))
    return any(looks[-1].stamp_ns > state.asked_ns for looks in pairs if looks)


def _is_witnessed(name: str, graph: RigGraph, histories: Mapping[str, History], since_ns: int) -> bool:
    """Whether two pairs of a sensor were looked at since a stamp. What a single one of several says may be its own,
    such as a clock of one driver; another would deny it. A sensor with one pair is witnessed while that pair suspects a
    move by itself, or if it stepped farther than a poor street bends all looks: nobody else tells the two apart."""
    of_pairs = [histories[edge.name] for edge in graph.edges if name in (edge.a, edge.b)]
    if len(of_pairs) > 1:
        return sum(bool(of.looks) and of.looks[-1].stamp_ns >= since_ns for of in of_pairs) >= 2
    (history,) = of_pairs
    clear = [look for look in history.looks if look.stamp_ns >= since_ns and not look.weak]
    return bool(clear) and (clear[-1].stepped_ns is not None or _stepped(history, since_ns, POOREST))


def _stepped(history: History, since_ns: int, place_times: float = 1.0) -> bool:
    """Whether an edge lies elsewhere since a stamp, by more than chance; with so many times the scatter of streets."""
    step = steps_at(history, [since_ns])
    place = np.max([look.place for look in history.looks], axis=0)
    covariance = step.covariance[0] + np.diag(2.0 * (place_times**2 - 1.0) * place**2)
    apart = float(dense.squared(dense.inverse(covariance), step.xi[0]))
    return bool(step.looks[0] >= SEEN and apart > STEPPED2)


def _times_ns(histories: Mapping[str, History], stepped_ns: int) -> list[int]:
    """Stamps of looks from which on they may lie after a step, the newest first: times that no look lies between are
    one. The likeliest of the last answer, `stepped_ns`, and those since which pairs are suspected by themselves do not
    drift as looks grow old, as ages do."""
    looked = [history.looks for history in histories.values() if history.looks]
    last_ns = sorted({looks[-1].stamp_ns for looks in looked}, reverse=True)
    aged_ns = [last_ns[0] - round(age_s * NS_PER_S) for age_s in AGES_S]
    just_after = (stamp_ns + 1 for stamp_ns in last_ns[1:NEWEST])
    suspected = sorted({looks[-1].stepped_ns for looks in looked if looks[-1].stepped_ns is not None})[:MOST_SUSPECTED]
    all_ns = sorted({look.stamp_ns for looks in looked for look in looks})
    first_after = (bisect_left(all_ns, at_ns) for at_ns in (*just_after, *aged_ns, stepped_ns, *suspected))
    # From the first of all on is before all.
    found = {all_ns[place] for place in first_after if 0 < place < len(all_ns)}
    return sorted({last_ns[0], *found, BEFORE_ALL_NS}, reverse=True)


def _posterior(histories: Mapping[str, History], times_ns: list[int], graph: RigGraph) -> Posterior:
    # Levers and axes as they were before: what was built may be far from it.
    edges = [Edge(edge.name, edge.a, edge.b, histories[edge.name].pose) for edge in graph.edges]
    current = RigGraph.of(graph.sensors, edges, graph.links)
    return who_moved(current, {name: steps_at(history, times_ns) for name, history in histories.items()})


def sensors(state: RigState, graph: RigGraph) -> tuple[SensorState, ...]:
    """What is believed of every sensor that can move, by name."""
    return tuple(_state(state, graph, sensor) for sensor in graph.sensors if sensor.kind is not Kind.VEHICLE)


def _state(state: RigState, graph: RigGraph, sensor: Sensor) -> SensorState:
    edges = [edge.name for edge in graph.edges if sensor.name in (edge.a, edge.b)]
    looked = [name for name in edges if state.histories[name].looks]
    of = state.posterior
    if of is None and sensor.name in state.named:
        text = "It had moved when the service was stopped; no pair of it was looked at since."
        return SensorState(sensor.name, sensor.kind, _moved(sensor), 1.0, None, (Reason("last_known", text),))
    if of is None or not looked:
        text = "No pair of it was looked at yet." if edges else "No pair has it: nothing can tell where it is."
        return SensorState(sensor.name, sensor.kind, SensorHealth.UNKNOWN, 0.0, None, (Reason("not_looked_at", text),))
    probability = of.sensors[sensor.name]
    disturbed = max((of.disturbed[name] for name in edges), default=0.0)
    moved = of.steps.get(sensor.name) if probability > 1.0 - NAMED_AT else None
    if sensor.name in state.named:
        health = _moved(sensor)
        reasons: tuple[Reason, ...] = (_named(sensor, probability, moved, looked, of),)
    elif max(probability, disturbed) > 1.0 - NAMED_AT:
        health, reasons = SensorHealth.UNDECIDED, _undecided(sensor, probability, disturbed, edges, of)
        if probability >= NAMED_AT:
            decides = (
                "a window of it decides" if _is_hidden(sensor.name, _probable(of), graph) else "the next looks decide"
            )
            text = f"It seems to have moved ({100.0 * probability:.1f} %); {decides}."
            reasons = (Reason("one_more_look", text), *reasons[1:])
    else:
        health = SensorHealth.CALIBRATED
        text = f"What was looked at fits without a move of it: {', '.join(looked)}."
        reasons = (Reason("fits", text),)
    return SensorState(sensor.name, sensor.kind, health, probability, moved, reasons)


def _moved(sensor: Sensor) -> SensorHealth:
    return SensorHealth.CAMERA_MOVED if sensor.kind is Kind.CAMERA else SensorHealth.LIDAR_MOVED


def _named(sensor: Sensor, probability: float, moved: Moved | None, looked: list[str], of: Posterior) -> Reason:
    since = [name for name in looked if name in of.looked_at]
    far = "" if moved is None else f" by {_size(moved)}"
    others = [name for name in of.sets[0][0] if name != sensor.name]
    beside = f", together with {', '.join(others)}" if others else ""
    text = f"It moved{far}{beside}: seen by {', '.join(since)}; all else fits ({100.0 * probability:.1f} %)."
    return Reason("moved", text)


def _undecided(
    sensor: Sensor, probability: float, disturbed: float, edges: list[str], of: Posterior
) -> tuple[Reason, ...]:
    reasons = []
    if probability > 1.0 - NAMED_AT:
        rivals = [" and ".join(names) for names, _ in of.sets if sensor.name not in names][:3]
        or_else = f" or {', or '.join(rivals)}" if rivals else ", or nothing did"
        text = f"It moved{or_else}: the pairs that were looked at cannot tell ({100.0 * probability:.0f} %)."
        reasons.append(Reason("cannot_tell", text))
    if disturbed > 1.0 - NAMED_AT:
        pair = max(edges, key=lambda name: of.disturbed[name])
        text = f"{pair} is off, and other pairs deny that a sensor moved: {100.0 * disturbed:.0f} %."
        reasons.append(Reason("pair_disturbed", text))
    return tuple(reasons)


def _size(moved: Moved) -> str:
    turn = degrees(float(np.sqrt(np.sum(moved.x[:3] ** 2))))
    shift_cm = 100.0 * float(np.sqrt(np.sum(moved.x[3:] ** 2)))
    return f"{turn:.2f}° and {shift_cm:.1f} cm"
