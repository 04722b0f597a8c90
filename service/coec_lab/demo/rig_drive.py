"""The vehicle of the demonstration of a rig: what its sensors see at the instants of looks, act by act.

A frame of a sensor that did not move is the same in every act and is drawn once. Other processes draw frames some
instants ahead, while the service starts and while it looks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Protocol

from coec.evaluation.rig_looks import TURN_S
from coec.simulation.drawing import drawing
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigDrive
from coec.simulation.rig_instants import Instant, instants
from coec.simulation.schedule import Arrival
from coec.sources.recording import Message
from coec_lab.demo.rig import story
from coec_lab.demo.rig.story import Act
from coec_lab.demo.vehicle import RENDERERS

NS_PER_S = 1_000_000_000

AHEAD = 6
"""Instants that are drawn, or wait to be, ahead of the one that is sent. Each costs four seconds of a core, which are
wasted when an act ends; so many keep the drawers busy while the service starts."""

AS_BUILT = 0
"""Number of the drive in which no sensor is knocked; the drives of the acts follow in their order."""


class Draws(Protocol):
    """Draws frames, see `simulation.drawing`."""

    def draw(self, drive: int, entry: Arrival) -> Future[Message]:
        """Draws an entry of the plan of the drive with this number."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Frames of one instant: a sweep, a picture by camera, and the motion around them."""

    sweep: Message
    pictures: Mapping[str, Message]
    motions: tuple[Message, ...]

    @property
    def second(self) -> float:
        """Second of the drive."""
        return (self.sweep.stamp_ns - START_NS) / NS_PER_S


class RigVehicle:
    """Drives the same street in every act."""

    def __init__(self, drawers: Draws) -> None:
        """Raises SourceError: the library that casts rays is not installed."""
        self.as_built = RigDrive(story.drive_config(None))
        self._drawers = drawers
        self._begun: dict[tuple[int, Arrival], Future[Message]] = {}

    @cached_property
    def plan(self) -> list[Instant]:
        """The instants, which are the same in every act."""
        return instants(self.as_built, story.LIDAR, TURN_S)

    def frames(self, act: Act) -> Iterator[Frames]:
        """All frames of an act, in order. The first are already being drawn when this returns."""
        if not self._begun:
            self._draw_first()
        begun = ((instant, self._begin(act, instant)) for instant in self.plan)
        waiting = deque(islice(begun, AHEAD))
        return self._in_order(waiting, begun)

    def _in_order(
        self, waiting: deque[tuple[Instant, Sequence[Future[Message]]]],
        begun: Iterator[tuple[Instant, Sequence[Future[Message]]]],
    ) -> Iterator[Frames]:  # fmt: skip
        while waiting:
            instant, frames = waiting.popleft()
            sweep, *pictures = (frame.result() for frame in frames)
            waiting.extend(islice(begun, 1))
            motions = tuple(self.as_built.message(entry) for entry in instant.motions)
            yield Frames(sweep, dict(zip(instant.pictures, pictures, strict=True)), motions)

    def _draw_first(self) -> None:
        """Draw the first instant in this process. What this compiles, once per machine, is reported to the waiting
        user, and every drawer finds it compiled."""
        for entry in (self.plan[0].sweep, *self.plan[0].pictures.values()):
            drawn: Future[Message] = Future()
            drawn.set_result(self.as_built.message(entry))
            self._begun[AS_BUILT, entry] = drawn

    def _begin(self, act: Act, instant: Instant) -> Sequence[Future[Message]]:
        """Begin to draw the sweep and the pictures of an instant, unless an earlier act has."""
        entries = (instant.sweep, *instant.pictures.values())
        numbered = [(self._drive_of(act, entry), entry) for entry in entries]
        for drive, entry in numbered:
            if (drive, entry) not in self._begun:
                self._begun[drive, entry] = self._drawers.draw(drive, entry)
        return [self._begun[one] for one in numbered]

    def _drive_of(self, act: Act, entry: Arrival) -> int:
        """Number of the drive that an entry is drawn from: the act's, for its knocked sensor after the knock, else the
        drive as built."""
        moved = self.as_built.stream(act.sensor)
        knocked = entry.stream == moved and entry.stamp_ns - START_NS >= story.KNOCK_S * NS_PER_S
        return 1 + story.ACTS.index(act) if knocked else AS_BUILT


@contextmanager
def driving() -> Iterator[RigVehicle]:
    """The vehicle, with processes that draw what it sees.

    Raises:
        SourceError: the library that casts rays is not installed.
    """
    configs = [story.drive_config(act) for act in (None, *story.ACTS)]
    with drawing(configs, RENDERERS) as drawers:
        yield RigVehicle(drawers)
