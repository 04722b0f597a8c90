"""One clock for all pairs that goes as the drive goes: with the stamps of whichever pair is in front.

The budget is earned by it, so a drive that is replayed at ten times its pace earns, and spends, ten times as much in a
second: it is judged by the same checks, on any machine that keeps up.
"""

from __future__ import annotations

NS_PER_S = 1_000_000_000


class DriveClock:
    """Seconds of driving since the first stamp. Stamps of one pair have nothing to do with those of another."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._last_ns: dict[str, int] = {}
        self._reached_s: dict[str, float] = {}

    def observe(self, pair: str, stamp_ns: int, gap_s: float) -> float:
        """The stream of a pair has come to a stamp; what time it is now, s. A step back, or ahead by more than `gap_s`,
        is no driving: the pair goes on from where the others are, as does one that has fallen behind by so much."""
        last_ns = self._last_ns.get(pair)
        self._last_ns[pair] = stamp_ns
        passed_s = 0.0 if last_ns is None else (stamp_ns - last_ns) / NS_PER_S
        reached_s = self._reached_s.get(pair, self.now_s)
        if not 0.0 <= passed_s <= gap_s or self.now_s - reached_s > gap_s:
            reached_s, passed_s = self.now_s, 0.0
        self._reached_s[pair] = reached_s + passed_s
        self.now_s = max(self.now_s, reached_s + passed_s)
        return self.now_s
