"""Who of a fleet said what last, and how urgent that is. Pure: it is told what came, and what time it is.

Nothing is invented: a pair that is silent keeps the state that it had said, and is shown as silent, never as healthy.
No clock but one's own is trusted with an age where it can be helped: of a word that was heard as it was said the age
counts from then; of one that was kept, there is only its vehicle's clock to go by.
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
"""That are kept, some 3 kB each: who floods takes no more memory than a fleet does."""

OVERDUE_PERIODS: Final = 2.5
"""Of a pair's own period without a word, after which it is silent: one word may be lost on the way."""

RANKS: Final = ("miscalibrated", "suspect", "degraded", "silent", "stale", "unknown", "healthy", "parked")
"""The most urgent first. Who knows that it is wrong comes before who says nothing."""

Name = tuple[str, str]
"""Vehicle and pair."""

_Place = tuple[int, float, float, Name]
"""In the order of urgency."""


@dataclass(slots=True)
class _Heard:
    """A word, when it was said by the watcher's steady clock, which axis drifted furthest and how far, in multiples of
    what a monitor has to see; and whether its vehicle has gone since."""

    word: LastWord
    said_s: float
    axis: int | None
    urgency: float
    gone: bool = False


@dataclass(frozen=True, slots=True)
class Filter:
    """Which pairs are looked at: those in one of the states (or `parked`, `silent`; none: all), with a text in the
    name of vehicle or pair."""

    states: frozenset[str] = frozenset()
    text: str = ""

    def passes(self, name: Name, told: str) -> bool:
        """Whether a pair, that is told as in this state, is looked at."""
        return (not self.states or told in self.states) and (not self.text or self.text in f"{name[0]}/{name[1]}")


EVERYTHING: Final = Filter()


class Roster:
    """Of one fleet. Owned by one thread."""

    def __init__(self, most: int = MAX_PAIRS) -> None:
        self._most = most
        self._heard: dict[Name, _Heard] = {}
        self._refused: Counter[str] = Counter()

    def hear(self, key: str, payload: bytes, now_s: float) -> None:
        """A word as it is said; `now_s` by the steady clock. What is none is counted."""
        word = self._read(key, payload)
        if word is not None:
            self._take(word, now_s)

    def recall(self, key: str, payload: bytes, now_s: float, wall_ns: int) -> None:
        """A word that was kept, or that was asked for: it stands where none is known that was said later."""
        word = self._read(key, payload)
        if word is None:
            return
        known = self._heard.get((word.vehicle, word.pair))
        if known is None or word.said_ns > known.word.said_ns:
            self._take(word, now_s - max((wall_ns - word.said_ns) * 1e-9, 0.0))

    def present(self, vehicle: str, pair: str, *, is_there: bool) -> None:
        """Its token came or went. That one came says nothing yet of what it says."""
        known = self._heard.get((vehicle, pair))
        if known is not None and not is_there:
            known.gone = True

    def refuse(self, cause: str, count: int = 1) -> None:
        """Something that was no word."""
        self._refused[cause] += count

    def overdue(self, now_s: float, most: int) -> list[Name]:
        """Pairs that are silent though nobody said that they have gone, those that have been the longest first: a word
        of theirs may have been lost, and they can be asked."""
        found = [
            (heard.said_s, name)
            for name, heard in self._heard.items()
            if not heard.gone and _standing(heard, now_s) == "silent"
        ]
        return [name for _, name in sorted(found)[:most]]

    def now(self, now_s: float, chosen: Filter = EVERYTHING, most: int = MAX_PAIRS) -> FleetNow:
        """What there is to tell, at most so many pairs of it."""
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

    def _take(self, word: LastWord, said_s: float) -> None:
        name = (word.vehicle, word.pair)
        if name not in self._heard and len(self._heard) >= self._most:
            self._refused["too_many_pairs"] += 1
            return
        self._heard[name] = _Heard(word, said_s, *_drift(word))


def of_states(names: Iterable[str], refuse: Callable[[str], Exception]) -> frozenset[str]:
    """States that a filter may name.

    Raises:
        Exception: that which `refuse(text)` makes, where one is none.
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
    """A pair that was last known to be wrong stays in front, wherever it is now."""
    by_state = RANKS.index(word.state)
    if standing == "live" or word.state == "miscalibrated":
        return by_state
    return min(by_state, RANKS.index("silent")) if standing == "silent" else RANKS.index("parked")


def _drift(word: LastWord) -> tuple[int | None, float]:
    """The axis that drifted furthest, and how far, in multiples of what a monitor has to see."""
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
