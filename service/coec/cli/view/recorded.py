"""Shows a recording at the cadence at which it was recorded, for as long as somebody may look."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from coec.adapters.foxglove.server import Screen
from coec.adapters.foxglove.shown import picture_of
from coec.adapters.foxglove.topics import PICTURES
from coec.adapters.zenoh.cadence import repeated
from coec.adapters.zenoh.player import shifted
from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import FramePair
from coec.cli.view.candidate import Candidate
from coec.cli.view.moments import extrinsics_of_recording, moment_of_recording
from coec.config import LimitsConfig, PairingConfig
from coec.errors import DecodeError, SourceError
from coec.sources import Recording
from coec.sources.windows import RECORDED_GAP_S

NS_PER_S = 1_000_000_000

AGAIN_S = 1.0
"""Time between two lines of the timeline, and between two redraws of the pair for viewers who have come since."""

LOOK_S = 0.05
"""Time between two checks whether a viewer has come."""

DEFAULT_PERIOD_NS = 100_000_000
"""Time between two passes of a recording with a single frame: 10 Hz."""


@dataclass(frozen=True, slots=True)
class Show:
    """What is played, and how. `rate`: multiple of the recorded speed, above zero. `found`: the candidate, if any."""

    recording: Recording
    found: Candidate | None
    rate: float
    repeat: bool


class Stage:
    """The pair that is on the screen, and the state beside it."""

    def __init__(self, show: Show, screen: Screen) -> None:
        rig, served = show.recording.rig, show.recording.T_camera_lidar_start
        configuration = show.recording.configuration
        self._rig = rig
        self._screen = screen
        self._extrinsics = extrinsics_of_recording(rig, served, show.found)
        self._moment = moment_of_recording(rig, served, show.found)
        self._compensated = configuration is None or configuration.motion_compensation
        self._pair: FramePair | None = None
        self._told_s = self._drawn_s = -math.inf
        self.refused: Counter[str] = Counter()

    def put(self, pair: FramePair) -> None:
        """Show another pair."""
        self._pair = pair
        self._draw()

    def rest(self, until: Callable[[], bool], stop: threading.Event) -> None:
        """Wait until a condition holds, or until told to stop; meanwhile tell and draw again now and then."""
        while not stop.is_set():
            now_s = time.monotonic()
            if now_s - self._told_s >= AGAIN_S:
                self._told_s = now_s
                self._screen.tell(self._moment)
            if now_s - self._drawn_s >= AGAIN_S:
                self._draw()
            if until():
                break
            stop.wait(LOOK_S)

    def rest_until(self, due_s: float, stop: threading.Event) -> None:
        """Wait until a time of the steady clock."""
        self.rest(lambda: time.monotonic() >= due_s - LOOK_S, stop)
        stop.wait(min(max(due_s - time.monotonic(), 0.0), LOOK_S))

    def _draw(self) -> None:
        self._drawn_s = time.monotonic()
        wanted = self._screen.wanted
        if self._pair is None or not wanted & PICTURES:
            return
        try:
            picture = picture_of(
                self._pair, self._rig, self._extrinsics, wanted, LimitsConfig(), compensated=self._compensated
            )
        except DecodeError as error:
            self.refused[error.reason] += 1
            self._pair = None
        else:
            self._screen.show(picture)


def play(show: Show, screen: Screen, stop: threading.Event) -> Counter[str]:
    """Plays the recording from when the first viewer looks; its last pair stays on the screen until told to stop.
    Returns the number of pairs that could not be shown, by cause.

    Raises:
        SourceError: a file cannot be read, or no camera frame found a sweep.
    """
    stage = Stage(show, screen)
    stage.rest(lambda: bool(screen.wanted & PICTURES), stop)
    due_s, before_ns = time.monotonic(), None
    for pair in _pairs(show):
        # A recording that cannot be read as fast as it was recorded takes longer; nothing is left out.
        step_ns = 0 if before_ns is None else pair.stamp_ns - before_ns
        due_s, before_ns = max(due_s + step_ns / NS_PER_S / show.rate, time.monotonic()), pair.stamp_ns
        stage.rest_until(due_s, stop)
        if stop.is_set():
            return stage.refused
        stage.put(pair)
    stage.rest(lambda: False, stop)
    return stage.refused


def _pairs(show: Show) -> Iterator[FramePair]:
    """All pairs in order, again and again if the recording is repeated; sensor time goes on."""
    recording = show.recording
    expects_motion = len(recording.motion_stamps_ns) > 0
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=expects_motion)
    stamps_ns = recording.camera_stamps_ns
    period_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else DEFAULT_PERIOD_NS
    end_ns = math.inf if not stamps_ns else 2 * stamps_ns[-1] - stamps_ns[0] + period_ns
    found = False
    for message in repeated(recording.messages, shifted, 0, period_ns, show.repeat):
        for pair in pairer.push(message):
            found = True
            yield pair
        if not found and message.stamp_ns > end_ns:
            break
    for pair in pairer.flush():
        found = True
        yield pair
    if not found:
        raise SourceError(
            f"{recording.name}: no camera frame has a sweep within {PairingConfig().tolerance_s} s: check the stamps "
            "of both"
        )
