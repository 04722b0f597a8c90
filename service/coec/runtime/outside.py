"""What the pairs of a vehicle have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from coec.adapters.files.scribe import Scribe
from coec.adapters.zenoh.bus import Answer
from coec.calibration.types import FramePair, Matrix4, Reason
from coec.config import PairConfig
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.worker.supervisor import Worker
from coec.schemas.keys import Keys


@dataclass(frozen=True, slots=True)
class Outside:
    """Everything that a pair shares. `publish(key, answer)`, `vehicle_troubles()` and `show(pair, drawn, pose)`, which
    tells of a pair of the stream that is being checked at an extrinsic (4, 4), may be called from any thread."""

    keys: Keys
    store: StateStore
    scribe: Scribe
    folder: WindowStore
    worker: Worker
    publish: Callable[[str, Answer], None]
    vehicle_troubles: Callable[[], tuple[Reason, ...]]
    show: Callable[[PairConfig, FramePair, Matrix4], None]
