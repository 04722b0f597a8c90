"""Answers about an awaited pair: that it is awaited, and what is missing. For any thread."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Never

from coec.adapters.exports.told import ExportFrames
from coec.adapters.ros.messages import CAMERA_INFO
from coec.adapters.zenoh.bus import Answer
from coec.calibration.lifecycle import CalibrationStatus, HealthState
from coec.calibration.types import Reason
from coec.config import OpenPairConfig
from coec.errors import CoecError
from coec.runtime.api.extrinsic import axes_of
from coec.runtime.api.health import reasons_of
from coec.runtime.api.snapshots import SerializedReply
from coec.runtime.decisions.incidents import Side
from coec.runtime.nominal.findings import info_topic_of
from coec.runtime.nominal.watch import NominalStatus
from coec.runtime.outside import VehicleContext
from coec.schemas import replies
from coec.schemas.commands import COMMAND_NAMES
from coec.schemas.keys import Format


class PendingPairError(CoecError):
    """The pair has no nominal calibration yet, so there is nothing to serve."""

    reply_code = "awaiting"


class PendingPairAnswers:
    """The answers of one pair. `renew` is for the main thread, once a second."""

    def __init__(self, pair: OpenPairConfig, vehicle: str, context: VehicleContext) -> None:
        self.name = pair.name
        self._vehicle = vehicle
        self._context = context
        self._pair = pair
        self._since_ns = time.time_ns()
        self._published: object = None
        self._fault: tuple[Reason, ...] = ()
        self.commands = PendingPairCommands(pair.name, vehicle, lambda: _sentence(self._nominal))
        self.renew()

    @property
    def _nominal(self) -> NominalStatus:
        return self._context.nominal(self.name)

    def renew(self) -> None:
        """Serialises the answers anew, and publishes what has changed."""
        awaits = self._nominal.awaits
        reasons = (*awaits, *self._context.vehicle_problems(), *self._fault)
        self.health_reply = replies.HealthReply(
            vehicle=self._vehicle,
            pair=self.name,
            state=HealthState.UNKNOWN.value,
            level=replies.ROS_LEVELS[HealthState.UNKNOWN.value],
            reasons=reasons_of(reasons),
            metrics={},
            axes=axes_of(None, CalibrationStatus.NOT_ACCEPTED),
            needs=(*(reason.text for reason in awaits), *self._absent()),
            data_quality=replies.DataQuality(),
            since_ns=self._since_ns,
            evaluated_ns=None,
            age_s=None,
        )
        self._snapshot = SerializedReply.of(self.health_reply)
        if self._published != reasons:
            self._published = reasons
            self._context.publish(self._context.keys.health(self.name), self._snapshot.answer("msgpack"))

    def _absent(self) -> list[str]:
        """A sentence for each wanted topic that nobody publishes; it lists the topics that exist."""
        topics, pair = self._context.topics(), self._pair
        required = [(stream.topic, stream.types) for stream in pair.streams.values()]
        required.append((info_topic_of(pair), (CAMERA_INFO,)))
        sentences = (None if topic is None else topics.absent(topic, types) for topic, types in required)
        return [sentence for sentence in sentences if sentence is not None]

    def fail(self, reason: Reason) -> None:
        """Reports that the service is about to end, for this reason."""
        self._fault = (reason,)
        self.renew()

    def status(self) -> replies.PairStatus:
        """Status with what is missing; there is hardly anything to count."""
        return replies.PairStatus(
            name=self.name,
            ego=replies.StreamStatus() if self._pair.ego is not None else None,
            commands=self.commands.counts,
            losses=dict(self._nominal.losses),
            awaits=reasons_of(self._nominal.awaits),
            found=dict(self._nominal.origins),
        )

    def health(self, form: Format) -> Answer:
        """The health: unknown, with the reasons."""
        return self._snapshot.answer(form)

    def extrinsic(self, form: Format) -> Answer:
        """Always refuses.

        Raises:
            AwaitedError: there is no nominal calibration yet.
        """
        del form
        self._refuse()

    def exported(self, form: str, frames: ExportFrames) -> Answer:
        """As `extrinsic`."""
        del form, frames
        self._refuse()

    def history(self, since_ns: int, until_ns: int, limit: int) -> replies.HistoryReply:
        """As `extrinsic`, because it depends on the rig whose history it is."""
        del since_ns, until_ns, limit
        self._refuse()

    def windows(self, form: Format) -> Answer:
        """As `extrinsic`."""
        del form
        self._refuse()

    def read_window(self, window_id: str, offset: int, length: int) -> bytes:
        """As `extrinsic`."""
        del window_id, offset, length
        self._refuse()

    def events(self) -> replies.EvidenceReply:
        """As `extrinsic`."""
        self._refuse()

    def event(self, event_id: str) -> replies.EvidenceEvent:
        """As `extrinsic`."""
        del event_id
        self._refuse()

    def event_overlay(self, event_id: str, side: Side) -> bytes:
        """As `extrinsic`."""
        del event_id, side
        self._refuse()

    def overlay(self, window_id: str | None, *, nominal: bool) -> bytes:
        """As `extrinsic`."""
        del window_id, nominal
        self._refuse()

    def _refuse(self) -> Never:
        raise PendingPairError(_sentence(self._nominal))


class PendingPairCommands:
    """The commands of one pair: every command is understood, and refused with what is missing."""

    def __init__(self, pair: str, vehicle: str, sentence: Callable[[], str]) -> None:
        self._pair = pair
        self._vehicle = vehicle
        self._sentence = sentence
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> dict[str, int]:
        """Commands since the start, by name and outcome."""
        with self._lock:
            return dict(self._counts)

    def carry_out(
        self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = 0.0
    ) -> replies.Acknowledgement:
        """Refuses the command, and says why."""
        del arguments, sender, deadline_s
        self._count(f"{name}_refused")
        return replies.Acknowledgement(
            vehicle=self._vehicle,
            pair=self._pair,
            command=name,
            accepted=False,
            code=PendingPairError.reply_code,
            text=self._sentence(),
        )

    def reserve_for(self, senders: Sequence[str]) -> None:
        """Does nothing: there is no rate limit here."""

    def note_refused(self, name: str, sender: str, why: CoecError) -> None:
        """Counts a command that its sender may not give."""
        del sender, why
        self._count(f"{name if name in COMMAND_NAMES else 'unknown'}_not_allowed")

    def _count(self, what: str) -> None:
        with self._lock:
            self._counts[what] += 1


def _sentence(nominal: NominalStatus) -> str:
    return " ".join(["This pair waits for its nominal calibration.", *(reason.text for reason in nominal.awaits)])
