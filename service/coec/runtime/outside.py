"""What all pairs of a vehicle share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from coec.adapters.files.scribe import Scribe
from coec.adapters.zenoh.bus import Answer
from coec.adapters.zenoh.ros_topics import Topics
from coec.calibration.types import FramePair, Matrix4, Reason
from coec.config import PairConfig
from coec.runtime.budget.budget import Budget
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.ingest.intake import Intake
from coec.runtime.nominal.watch import Nominal
from coec.runtime.recording.snippet_store import SnippetStore
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.rig.keeper import RigKeeper
from coec.runtime.worker.supervisor import Worker
from coec.schemas.keys import Keys


def given(pair: str) -> Nominal:
    """Default of `Outside.nominal`: the pair's configuration gives its nominal calibration."""
    del pair
    return Nominal()


def fits(pair: str) -> tuple[Reason, ...]:
    """Default of `Outside.rig_troubles`: the pair contradicts no other."""
    del pair
    return ()


@dataclass(frozen=True, slots=True)
class Outside:
    """Everything that a pair shares with the others. The callables may be called from any thread.

    Attributes:
        intake: takes the samples of all pairs.
        show: `show(pair, drawn, pose)` reports a pair of frames that is being checked at an extrinsic (4, 4).
        topics: the topics that the vehicle's ROS publishes now.
        nominal: where the nominal calibration of a pair, given by name, comes from.
        rig_troubles: in what a pair, given by name, contradicts the vehicle's other pairs.
        snippets: store for the seconds around an event; None: they are not kept.
    """

    keys: Keys
    intake: Intake
    store: StateStore
    scribe: Scribe
    folder: WindowStore
    worker: Worker
    budget: Budget
    rig: RigKeeper
    publish: Callable[[str, Answer], None]
    vehicle_troubles: Callable[[], tuple[Reason, ...]]
    show: Callable[[PairConfig, FramePair, Matrix4], None]
    topics: Callable[[], Topics]
    nominal: Callable[[str], Nominal] = given
    rig_troubles: Callable[[str], tuple[Reason, ...]] = fits
    snippets: SnippetStore | None = None
