"""The vehicle of the demonstration of a rig: what its sensors see at the instants that are looked at, act by act.

A frame of a sensor that stands where it was built is the same in every act, and drawn once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from coec.cli.demo.rig import story
from coec.cli.demo.rig.story import Act
from coec.evaluation.rig_looks import TURN_S
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigDrive
from coec.simulation.rig_instants import Instant, instants
from coec.simulation.schedule import Arrival
from coec.sources.recording import Message

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Of one instant: a sweep, a picture by camera, and the motion around them."""

    sweep: Message
    pictures: Mapping[str, Message]
    motions: tuple[Message, ...]

    @property
    def second(self) -> float:
        """Of the drive."""
        return (self.sweep.stamp_ns - START_NS) / NS_PER_S


class RigVehicle:
    """Drives the same street in every act."""

    def __init__(self) -> None:
        """Raises SourceError: what casts the rays is not installed."""
        self.as_built = RigDrive(story.drive_config(None))
        self._drawn: dict[Arrival, Message] = {}

    @cached_property
    def plan(self) -> list[Instant]:
        """Instants of every act."""
        return instants(self.as_built, story.LIDAR, TURN_S)

    def frames(self, act: Act) -> Iterator[Frames]:
        """All of them, in order."""
        knocked = RigDrive(story.drive_config(act))
        moved = self.as_built.stream(act.sensor)

        def drawn(entry: Arrival) -> Message:
            if entry.stream == moved and entry.stamp_ns - START_NS >= story.KNOCK_S * NS_PER_S:
                return knocked.message(entry)
            if entry not in self._drawn:
                self._drawn[entry] = self.as_built.message(entry)
            return self._drawn[entry]

        for instant in self.plan:
            pictures = {camera: drawn(entry) for camera, entry in instant.pictures.items()}
            yield Frames(drawn(instant.sweep), pictures, tuple(drawn(entry) for entry in instant.motions))
