"""What the pairs of a vehicle have in common."""

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
    """Of a pair whose configuration gives its nominal calibration."""
    del pair
    return Nominal()


def fits(pair: str) -> tuple[Reason, ...]:
    """Of a pair that has nothing against any other."""
    del pair
    return ()


@dataclass(frozen=True, slots=True)
class Outside:
    """Everything that a pair shares. All that can be called may be called from any thread.

    Attributes:
        intake: takes the samples of all pairs.
        show: `show(pair, drawn, pose)` tells of a pair of the stream that is being checked at an extrinsic (4, 4).
        topics: those that the vehicle's ROS publishes now.
        nominal: where a pair's nominal calibration comes from.
        rig_troubles: what does not fit between a pair and the others of the vehicle, by its name.
        snippets: where the seconds around an event are kept; None: they are not.
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
