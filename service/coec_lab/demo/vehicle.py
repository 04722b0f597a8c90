"""The vehicle of the demonstration: renders its drive ahead in other processes, and publishes it at a suitable pace."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import zenoh

from coec.adapters.zenoh.cadence import Played
from coec.adapters.zenoh.player import CAMERA, Frame, Player, Streams

if TYPE_CHECKING:
    from coec.simulation.drive import SimulatedDrive

NS_PER_S = 1_000_000_000

RATE = 4.0
"""Most seconds of driving in a second; each half second, two pictures with their sweeps must be drawn."""

POLL_S = 0.05

RENDERERS = 2
"""Processes that draw, each with its own street in memory."""


class Vehicle:
    """Drives in a thread of its own.

    Attributes:
        stamp_ns: sensor time of the latest published frame; before that, of the first picture.
        played: how many frames of each stream were published.
        failure: why the thread ended early; None if it did not.
    """

    def __init__(self, session: zenoh.Session, drive: SimulatedDrive, may_pass: Callable[[int], bool]) -> None:
        """`may_pass` says whether the drive may go on to a sensor time."""
        self._drive = drive
        self._may_pass = may_pass
        self._player = Player(session, Streams.default(drive.rig.pair), "msgpack")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle")
        self.stamp_ns = drive.camera_stamps_ns[0]
        self.played: Played = self._player.played
        self.failure: Exception | None = None

    @property
    def arrived(self) -> bool:
        """Whether the drive is over."""
        return not self._thread.is_alive()

    @property
    def second(self) -> float:
        """The present second of the drive."""
        return max((self.stamp_ns - self._drive.camera_stamps_ns[0]) / NS_PER_S, 0.0)

    @property
    def pictures(self) -> int:
        """How many pictures have been sent."""
        return self.played.frames[CAMERA]

    def start(self, wait_s: float) -> list[str]:
        """Starts the drive once the service listens; returns the keys to which nobody listens after `wait_s`."""
        deaf = self._player.wait_for_listener(wait_s)
        if not deaf:
            self._thread.start()
        return deaf

    def stop(self) -> None:
        """Ends the drive."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._player.close()

    def _run(self) -> None:
        from coec.simulation.parallel import messages_by

        try:
            frames = messages_by(self._drive.config, min(os.cpu_count() or 1, RENDERERS))
            self._player.play(paced(frames, self._may_pass, self._stop), 0.0, self._stop, self._heard)
        except Exception as error:  # reported by the thread that watches
            self.failure = error

    def _heard(self, frame: Frame, _: Played) -> None:
        self.stamp_ns = frame.stamp_ns


def paced(
    frames: Iterable[Frame], may_pass: Callable[[int], bool], stop: threading.Event, rate: float = RATE
) -> Iterator[Frame]:
    """Yields each frame when it is due after the one before and the service has kept up.

    Args:
        may_pass: whether the drive may go on to a sensor time.
        stop: ends all waiting.
        rate: most seconds of driving in a second.
    """
    before_ns, before_s = None, 0.0
    for frame in frames:
        if before_ns is not None:
            stop.wait(max(before_s + (frame.stamp_ns - before_ns) / NS_PER_S / rate - time.monotonic(), 0.0))
        while not may_pass(frame.stamp_ns) and not stop.wait(POLL_S):
            pass
        before_ns, before_s = frame.stamp_ns, time.monotonic()
        yield frame
