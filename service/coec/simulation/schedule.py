"""The order in which the frames of all sensors arrive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from coec.simulation.aboard import SimulatedSensor
from coec.simulation.journey import START_NS


class Arrival(NamedTuple):
    """Frame `number` of stream `stream`, with its stamp. Sorts by stamp, then by stream."""

    stamp_ns: int
    stream: int
    number: int


def arrivals(streams: Sequence[SimulatedSensor], seconds: float) -> list[Arrival]:
    """Everything that arrives, in the order of the stamps."""
    plan = []
    for stream, sensor in enumerate(streams):
        for index in range(math.ceil(seconds * sensor.hz)):
            time_s = sensor.time_s(index)
            if not sensor.is_lost(index, time_s):
                plan.append(Arrival(START_NS + round((time_s + sensor.late_s(time_s)) * 1e9), stream, index))
    return sorted(plan)


def seconds_of(stamp_ns: int) -> float:
    """The second of the drive at a stamp."""
    return (stamp_ns - START_NS) / 1e9
