"""One clock for all pairs that shows the time of the drive, by the stamps of the pair that is farthest ahead.

The budget is earned by this clock. A replay at ten times the pace of the drive therefore earns and spends ten times as
much per second, and makes the same checks as the drive did, on any machine that keeps up.
"""

from __future__ import annotations

NS_PER_S = 1_000_000_000


class DriveClock:
    """Seconds of driving since the first stamp. The stamps of different pairs need not be of the same clock."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._last_ns: dict[str, int] = {}
        self._reached_s: dict[str, float] = {}

    def observe(self, pair: str, stamp_ns: int, gap_s: float) -> float:
        """The stream of a pair has come to a stamp. Returns the time now, s. A step back, or ahead by more than
        `gap_s`, does not count as driving: the pair goes on from where the others are. So does a pair that has fallen
        behind by more than `gap_s`."""
        last_ns = self._last_ns.get(pair)
        self._last_ns[pair] = stamp_ns
        passed_s = 0.0 if last_ns is None else (stamp_ns - last_ns) / NS_PER_S
        reached_s = self._reached_s.get(pair, self.now_s)
        if not 0.0 <= passed_s <= gap_s or self.now_s - reached_s > gap_s:
            reached_s, passed_s = self.now_s, 0.0
        self._reached_s[pair] = reached_s + passed_s
        self.now_s = max(self.now_s, reached_s + passed_s)
        return self.now_s
