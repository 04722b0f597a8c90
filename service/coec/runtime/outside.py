"""What the pairs of a vehicle have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from coec.adapters.files.scribe import Scribe
from coec.adapters.zenoh.bus import Answer
from coec.adapters.zenoh.ros_topics import Topics
from coec.calibration.types import Reason
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.nominal.watch import Nominal
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.worker.supervisor import Worker
from coec.schemas.keys import Keys


def given(pair: str) -> Nominal:
    """Of a pair whose configuration gives its nominal calibration."""
    del pair
    return Nominal()


@dataclass(frozen=True, slots=True)
class Outside:
    """Everything that a pair shares. `publish(key, answer)`, `vehicle_troubles()`, `topics()`, those that the vehicle's
    ROS publishes now, and `nominal(pair)`, where a pair's nominal calibration comes from, may be called from any
    thread."""

    keys: Keys
    store: StateStore
    scribe: Scribe
    folder: WindowStore
    worker: Worker
    publish: Callable[[str, Answer], None]
    vehicle_troubles: Callable[[], tuple[Reason, ...]]
    topics: Callable[[], Topics]
    nominal: Callable[[str], Nominal] = given
