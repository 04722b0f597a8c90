"""Hurries a window that is wanted soon: because the monitor suspects a move that only a window can confirm, or because
the rig named a sensor and waits for a window of each of its pairs.

An open slice that began before the mount moved mixes two extrinsics, so it is ended, whatever it holds. A slice that
began later is ended as soon as it is enough for a window, or replaced by a short dense one if that comes sooner.
"""

from __future__ import annotations

from coec.calibration.frames.window import SliceClosed, WindowCutter
from coec.config import MonitorConfig, WindowConfig

TRIES = 3
"""Urgent windows per suspicion: if these do not help, more of them will not either."""

MARGIN = 1.2
"""Factor by which a slice is longer than its pairs need at the rate at which they come."""

NS_PER_S_URGENT = 1_000_000_000


class UrgentWindow:
    """Hurries the `WindowCutter` of one pair while a window is wanted. Sensor time alone decides."""

    def __init__(self, monitor: MonitorConfig) -> None:
        self._monitor = monitor
        self._since_ns: int | None = None
        self._tries = 0
        self._hurried = False
        self._for_rig = False
        self._longer_s = 0.0

    @property
    def is_waiting(self) -> bool:
        """Whether a window is wanted and has not come."""
        return self._since_ns is not None

    def alarm(self, since_ns: int) -> None:
        """The pair suspects a move and wants a window of frames since `since_ns`. It does not wait for its turn, as
        pairs do that the rig waits for."""
        if (self._since_ns is None or self._for_rig) and self._tries < TRIES:
            self._request(since_ns, for_rig=False, longer_s=0.0)
            self._tries += 1

    def request(self, since_ns: int, longer_s: float) -> None:
        """The rig waits for a window of frames since `since_ns`, whatever the pair itself suspects. The slice is
        `longer_s` longer than an urgent one, because the pairs of a sensor are solved one after the other."""
        if self._since_ns is None:
            self._request(since_ns, for_rig=True, longer_s=longer_s)

    def calm(self) -> None:
        """The suspicion is over. A window for which the rig waits is still wanted."""
        self._tries = 0
        if not self._for_rig:
            self._since_ns = None

    def forget(self) -> None:
        """Nothing is wanted any more: sensor time has stepped back."""
        self.calm()
        self._since_ns = None

    def _request(self, since_ns: int, *, for_rig: bool, longer_s: float) -> None:
        self._since_ns, self._hurried = since_ns, False
        self._for_rig, self._longer_s = for_rig, longer_s

    def apply(self, cutter: WindowCutter, rate_hz: float | None) -> list[SliceClosed]:
        """Ends the slice of the cutter if necessary; to be called before a pair is offered to the cutter.

        Args:
            rate_hz: at which pairs come; None while unknown.
        """
        if self._since_ns is None:
            return []
        start_ns, enough = cutter.slice_start_ns, cutter.selected >= cutter.config.min_pairs
        if start_ns is None:
            return self._hurry(cutter, rate_hz)
        if start_ns < self._since_ns:
            return self._hurry(cutter, rate_hz)
        if self._hurried:
            return []
        if enough:
            self._since_ns = None
            return cutter.finish()
        lacking = cutter.config.min_pairs - cutter.selected
        waits_s = lacking * cutter.config.slice_s / cutter.config.pairs
        return [] if waits_s <= self._length_s(cutter.config, rate_hz) else self._hurry(cutter, rate_hz)

    def on_slice_closed(self, event: SliceClosed, cutter: WindowCutter, rate_hz: float | None) -> None:
        """A slice ended by itself. If it has enough pairs it is the window that was wanted; else the next one is
        hurried."""
        if self._since_ns is None or not self._hurried:
            return
        if event.complete:
            self._since_ns = None
        else:
            cutter.hurry(self._length_s(cutter.config, rate_hz))

    def _hurry(self, cutter: WindowCutter, rate_hz: float | None) -> list[SliceClosed]:
        closed = cutter.finish()
        cutter.hurry(self._length_s(cutter.config, rate_hz))
        self._hurried = True
        return closed

    def _length_s(self, window: WindowConfig, rate_hz: float | None) -> float:
        """Length of an urgent slice: as configured, or longer if pairs come slowly, but no longer than any other."""
        needed_s = MARGIN * window.pairs / rate_hz if rate_hz else 0.0
        return min(max(self._monitor.urgent_slice_s, needed_s) + self._longer_s, window.slice_s)
