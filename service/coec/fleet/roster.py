"""The last word of each pair of a fleet, and how urgent it is. Pure: words and times come from the caller.

Nothing is invented: a silent pair keeps the last state that it reported, and is shown as silent, never as healthy. Ages
are counted by the watcher's own clock where possible. If a word was heard as it was said, its age counts from then; for
a word that was kept elsewhere, only its vehicle's clock is available.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, get_args

from coec.errors import DecodeError
from coec.schemas.fleet import SEEN
from coec.schemas.fleet_now import FleetNow, PairNow, Standing
from coec.schemas.last_word import LastWord, read
from coec.schemas.replies import HealthState

AXES: Final = ("rx", "ry", "rz", "tx", "ty", "tz")

MAX_PAIRS: Final = 200_000
"""How many pairs are kept, some 3 kB each. So a flood of words takes no more memory than a fleet does."""

MAX_WORD_BYTES: Final = 2**28
"""Most bytes of their last words together, as these came: as many words of the usual 1 kB have less. A word may have
16 kB."""

OVERDUE_PERIODS: Final = 2.5
"""After so many of its own periods without a word a pair is silent: one word may be lost on the way."""

RANKS: Final = ("miscalibrated", "suspect", "degraded", "silent", "stale", "unknown", "healthy", "parked")
"""States, the most urgent first. A pair that knows that it is wrong comes before one that says nothing."""

Name = tuple[str, str]
"""Vehicle and pair."""

_Place = tuple[int, float, float, Name]
"""Sort key of a pair in the order of urgency."""


@dataclass(slots=True)
class _Heard:
    """A word; when it was said, by the watcher's steady clock; which axis drifted furthest and how far, in multiples of
    the drift that a monitor has to detect; its size as it came, bytes; and whether its vehicle has gone since."""

    word: LastWord
    said_s: float
    axis: int | None
    urgency: float
    size: int
    gone: bool = False


@dataclass(frozen=True, slots=True)
class Filter:
    """Which pairs are shown: those in one of the states (or `parked`, `silent`; empty: all states) whose name contains
    the text. The name is that of the vehicle and the pair."""

    states: frozenset[str] = frozenset()
    text: str = ""

    def passes(self, name: Name, told: str) -> bool:
        """Whether a pair that is shown in state `told` passes."""
        return (not self.states or told in self.states) and (not self.text or self.text in f"{name[0]}/{name[1]}")


EVERYTHING: Final = Filter()


class Roster:
    """The last words of one fleet. Owned by one thread."""

    def __init__(self, most: int = MAX_PAIRS) -> None:
        self._most = most
        self._bytes = 0
        self._heard: dict[Name, _Heard] = {}
        self._refused: Counter[str] = Counter()

    def hear(self, key: str, payload: bytes, now_s: float) -> None:
        """Takes in a word as it is said, at `now_s` by the steady clock. Invalid words are counted."""
        word = self._read(key, payload)
        if word is not None:
            self._take(word, len(payload), now_s)

    def recall(self, key: str, payload: bytes, now_s: float, wall_ns: int) -> None:
        """Takes in a word that was kept or asked for, unless a later one is known."""
        word = self._read(key, payload)
        if word is None:
            return
        known = self._heard.get((word.vehicle, word.pair))
        if known is None or word.said_ns > known.word.said_ns:
            self._take(word, len(payload), now_s - max((wall_ns - word.said_ns) * 1e-9, 0.0))

    def present(self, vehicle: str, pair: str, *, is_there: bool) -> None:
        """The liveliness token of a pair came or went. A token that came does not say what the pair's state is."""
        known = self._heard.get((vehicle, pair))
        if known is not None and not is_there:
            known.gone = True

    def refuse(self, cause: str, count: int = 1) -> None:
        """Counts something that was no word."""
        self._refused[cause] += count

    def overdue(self, now_s: float, most: int) -> list[Name]:
        """Pairs that are silent although their token has not gone, the longest silent first. Their word may have been
        lost, so they can be asked."""
        found = [
            (heard.said_s, name)
            for name, heard in self._heard.items()
            if not heard.gone and _standing(heard, now_s) == "silent"
        ]
        return [name for _, name in sorted(found)[:most]]

    def now(self, now_s: float, chosen: Filter = EVERYTHING, most: int = MAX_PAIRS) -> FleetNow:
        """The fleet as it is now, with at most `most` of the chosen pairs."""
        states: Counter[str] = Counter()
        order: list[tuple[_Place, Standing, _Heard]] = []
        for name, heard in self._heard.items():
            standing = _standing(heard, now_s)
            told = heard.word.state if standing == "live" else standing
            states[told] += 1
            if chosen.passes(name, told):
                place = (_rank(heard.word, standing), -heard.urgency, heard.said_s, name)
                order.append((place, standing, heard))
        order.sort(key=lambda item: item[0])
        return FleetNow(
            vehicles=len({vehicle for vehicle, _ in self._heard}),
            known=len(self._heard),
            states=dict(sorted(states.items(), key=lambda item: RANKS.index(item[0]))),
            matching=len(order),
            pairs=tuple(_pair(heard, standing, now_s) for _, standing, heard in order[:most]),
            refused=dict(self._refused),
        )

    def _read(self, key: str, payload: bytes) -> LastWord | None:
        try:
            return read(key, payload)
        except DecodeError as error:
            self._refused[error.reason] += 1
            return None

    def _take(self, word: LastWord, size: int, said_s: float) -> None:
        name = (word.vehicle, word.pair)
        before = self._heard.get(name)
        total = self._bytes + size - (0 if before is None else before.size)
        if before is None and (len(self._heard) >= self._most or total > MAX_WORD_BYTES):
            self._refused["too_many_pairs"] += 1
            return
        if total > max(MAX_WORD_BYTES, self._bytes):
            self._refused["word_too_large"] += 1
            return
        self._bytes = total
        self._heard[name] = _Heard(word, said_s, *_drift(word), size)


def of_states(names: Iterable[str], refuse: Callable[[str], Exception]) -> frozenset[str]:
    """The names of a filter as a set of states.

    Raises:
        Exception: what `refuse(text)` returns, if a name is no state.
    """
    chosen = frozenset(names)
    known = (*get_args(HealthState), "parked", "silent")
    for name in sorted(chosen - set(known)):
        raise refuse(f"{name!a} is no state; there are: {', '.join(known)}")
    return chosen


def _standing(heard: _Heard, now_s: float) -> Standing:
    if heard.word.service == "stopping":
        return "parked"
    if heard.gone or now_s - heard.said_s > OVERDUE_PERIODS * heard.word.period_s:
        return "silent"
    return "live"


def _rank(word: LastWord, standing: Standing) -> int:
    """Rank of a pair. One that was last known to be wrong stays in front, even if it is silent or parked now."""
    by_state = RANKS.index(word.state)
    if standing == "live" or word.state == "miscalibrated":
        return by_state
    return min(by_state, RANKS.index("silent")) if standing == "silent" else RANKS.index("parked")


def _drift(word: LastWord) -> tuple[int | None, float]:
    """The axis that drifted furthest, and how far, in multiples of the drift that a monitor has to detect."""
    shares = [0.0 if moved is None else abs(moved) / seen for moved, seen in zip(word.drift or (), SEEN, strict=False)]
    furthest = max(shares, default=0.0)
    return (shares.index(furthest) if furthest > 0.0 else None), furthest


def _pair(heard: _Heard, standing: Standing, now_s: float) -> PairNow:
    said_s = max(now_s - heard.said_s, 0.0)
    return PairNow(
        word=heard.word,
        standing=standing,
        said_s=said_s,
        looked_s=None if heard.word.age_s is None else heard.word.age_s + said_s,
        worst=None if heard.axis is None else AXES[heard.axis],
        urgency=heard.urgency,
    )
