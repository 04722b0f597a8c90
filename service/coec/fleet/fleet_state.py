"""The last word of each pair of a fleet, and how urgent it is. Pure: words and times come from the caller.

Nothing is invented: a silent pair keeps the last state that it reported, and is shown as silent, never as healthy. Ages
are counted by the watcher's own clock where possible. If a word was heard as it was said, its age counts from then; for
a word that was kept elsewhere, only its vehicle's clock is available.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, get_args

from coec.errors import DecodeError
from coec.schemas.documents import SEEN, Connectivity, FleetNow, PairNow
from coec.schemas.heartbeat import LastWord, decode_heartbeat
from coec.schemas.replies import AXES, HealthState

MAX_PAIRS: Final = 200_000
"""How many pairs are kept, some 3 kB each. So a flood of words takes no more memory than a fleet does."""

MAX_WORD_BYTES: Final = 2**28
"""Most bytes of their last words together, as these came: as many words of the usual 1 kB have less. A word may have
16 kB."""

OVERDUE_PERIODS: Final = 2.5
"""After so many of its own periods without a word a pair is silent: one word may be lost on the way."""

RANKS: Final = ("miscalibrated", "suspect", "degraded", "silent", "stale", "unknown", "healthy", "parked")
"""States, the most urgent first. A pair that knows that it is wrong comes before one that says nothing."""

PairName = tuple[str, str]
"""Vehicle and pair."""

_SortKey = tuple[int, float, float, PairName]
"""Sort key of a pair in the order of urgency."""


@dataclass(slots=True)
class _FleetEntry:
    """A word; when it was said, by the watcher's steady clock; which axis drifted furthest and how far, in multiples of
    the drift that a monitor has to detect; its size as it came, bytes; and whether its vehicle has gone since."""

    heartbeat: LastWord
    published_s: float
    axis: int | None
    urgency: float
    size: int
    gone: bool = False


@dataclass(frozen=True, slots=True)
class FleetFilter:
    """Which pairs are shown: those in one of the states (or `parked`, `silent`; empty: all states) whose name contains
    the text. The name is that of the vehicle and the pair."""

    states: frozenset[str] = frozenset()
    text: str = ""

    def passes(self, name: PairName, state: str) -> bool:
        """Whether a pair that is shown in this state passes."""
        return (not self.states or state in self.states) and (not self.text or self.text in f"{name[0]}/{name[1]}")


NO_FILTER: Final = FleetFilter()


class FleetState:
    """The last words of one fleet. Owned by one thread."""

    def __init__(self, most: int = MAX_PAIRS) -> None:
        self._most = most
        self._bytes = 0
        self._entries: dict[PairName, _FleetEntry] = {}
        self._refused: Counter[str] = Counter()

    def on_heartbeat(self, key: str, payload: bytes, now_s: float) -> None:
        """Takes in a word as it is said, at `now_s` by the steady clock. Invalid words are counted."""
        heartbeat = self._read(key, payload)
        if heartbeat is not None:
            self._store(heartbeat, len(payload), now_s)

    def restore(self, key: str, payload: bytes, now_s: float, wall_ns: int) -> None:
        """Takes in a word that was kept or asked for, unless a later one is known."""
        heartbeat = self._read(key, payload)
        if heartbeat is None:
            return
        known = self._entries.get((heartbeat.vehicle, heartbeat.pair))
        if known is None or heartbeat.said_ns > known.heartbeat.said_ns:
            self._store(heartbeat, len(payload), now_s - max((wall_ns - heartbeat.said_ns) * 1e-9, 0.0))

    def on_liveliness(self, vehicle: str, pair: str, *, is_there: bool) -> None:
        """The liveliness token of a pair came or went. A token that came does not say what the pair's state is."""
        known = self._entries.get((vehicle, pair))
        if known is not None and not is_there:
            known.gone = True

    def count_refused(self, cause: str, count: int = 1) -> None:
        """Counts something that was no word."""
        self._refused[cause] += count

    def overdue(self, now_s: float, most: int) -> list[PairName]:
        """Pairs that are silent although their token has not gone, the longest silent first. Their word may have been
        lost, so they can be asked."""
        silent = [
            (entry.published_s, name)
            for name, entry in self._entries.items()
            if not entry.gone and _connectivity(entry, now_s) == "silent"
        ]
        return [name for _, name in sorted(silent)[:most]]

    def now(self, now_s: float, selection: FleetFilter = NO_FILTER, most: int = MAX_PAIRS) -> FleetNow:
        """The fleet as it is now, with at most `most` of the chosen pairs."""
        states: Counter[str] = Counter()
        order: list[tuple[_SortKey, Connectivity, _FleetEntry]] = []
        for name, entry in self._entries.items():
            connectivity = _connectivity(entry, now_s)
            state = entry.heartbeat.state if connectivity == "live" else connectivity
            states[state] += 1
            if selection.passes(name, state):
                sort_key = (_rank(entry.heartbeat, connectivity), -entry.urgency, entry.published_s, name)
                order.append((sort_key, connectivity, entry))
        order.sort(key=lambda item: item[0])
        return FleetNow(
            vehicles=len({vehicle for vehicle, _ in self._entries}),
            known=len(self._entries),
            states=dict(sorted(states.items(), key=lambda item: RANKS.index(item[0]))),
            matching=len(order),
            pairs=tuple(_pair_now(entry, connectivity, now_s) for _, connectivity, entry in order[:most]),
            refused=dict(self._refused),
        )

    def _read(self, key: str, payload: bytes) -> LastWord | None:
        try:
            return decode_heartbeat(key, payload)
        except DecodeError as error:
            self._refused[error.reason] += 1
            return None

    def _store(self, heartbeat: LastWord, size: int, published_s: float) -> None:
        name = (heartbeat.vehicle, heartbeat.pair)
        known = self._entries.get(name)
        total = self._bytes + size - (0 if known is None else known.size)
        if known is None and (len(self._entries) >= self._most or total > MAX_WORD_BYTES):
            self._refused["too_many_pairs"] += 1
            return
        if total > max(MAX_WORD_BYTES, self._bytes):
            self._refused["word_too_large"] += 1
            return
        self._bytes = total
        self._entries[name] = _FleetEntry(heartbeat, published_s, *_drift(heartbeat), size)


def parse_states(names: Iterable[str], refuse: Callable[[str], Exception]) -> frozenset[str]:
    """The names of a filter as a set of states.

    Raises:
        Exception: what `refuse(text)` returns, if a name is no state.
    """
    selected = frozenset(names)
    known = (*get_args(HealthState), "parked", "silent")
    for name in sorted(selected - set(known)):
        raise refuse(f"{name!a} is no state; there are: {', '.join(known)}")
    return selected


def _connectivity(entry: _FleetEntry, now_s: float) -> Connectivity:
    if entry.heartbeat.service == "stopping":
        return "parked"
    if entry.gone or now_s - entry.published_s > OVERDUE_PERIODS * entry.heartbeat.period_s:
        return "silent"
    return "live"


def _rank(heartbeat: LastWord, connectivity: Connectivity) -> int:
    """Rank of a pair. One that was last known to be wrong stays in front, even if it is silent or parked now."""
    by_state = RANKS.index(heartbeat.state)
    if connectivity == "live" or heartbeat.state == "miscalibrated":
        return by_state
    return min(by_state, RANKS.index("silent")) if connectivity == "silent" else RANKS.index("parked")


def _drift(heartbeat: LastWord) -> tuple[int | None, float]:
    """The axis that drifted furthest, and how far, in multiples of the drift that a monitor has to detect."""
    shares = [
        0.0 if moved is None else abs(moved) / seen for moved, seen in zip(heartbeat.drift or (), SEEN, strict=False)
    ]
    furthest = max(shares, default=0.0)
    return (shares.index(furthest) if furthest > 0.0 else None), furthest


def _pair_now(entry: _FleetEntry, connectivity: Connectivity, now_s: float) -> PairNow:
    age_s = max(now_s - entry.published_s, 0.0)
    return PairNow(
        word=entry.heartbeat,
        standing=connectivity,
        said_s=age_s,
        looked_s=None if entry.heartbeat.age_s is None else entry.heartbeat.age_s + age_s,
        worst=None if entry.axis is None else AXES[entry.axis],
        urgency=entry.urgency,
    )
