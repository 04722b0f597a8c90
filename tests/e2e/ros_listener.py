"""A stand-in for ROS nodes on rmw_zenoh: subscribes as rmw_zenoh does, and decodes with a reader that is not ours."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import AdvancedSubscriber, HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from coec.config import RosConfig, RosOutput, load_config
from coec.reports.commented_yaml import commented_yaml

_STORE = get_typestore(Stores.ROS2_JAZZY)


def speaking_to_ros(path: Path, *publish: RosOutput) -> None:
    """Make a written configuration one of a service that publishes this on rmw_zenoh's keys, of domain 0."""
    reported = {"middleware": "rmw_zenoh", "ros": RosConfig(publish=publish)}
    path.write_text(commented_yaml(load_config(path).model_copy(update=reported)))


@dataclass
class Listener:
    """What came, by topic, in the order in which it came."""

    samples: dict[str, list[zenoh.Sample]] = field(default_factory=lambda: defaultdict(list))
    decoded: dict[str, list[Any]] = field(default_factory=lambda: defaultdict(list))

    def messages(self, topic: str, type_name: str) -> list[Any]:
        """Decoded, each once: a test that waits looks at them again and again."""
        samples, decoded = self.samples[topic], self.decoded[topic]
        while len(decoded) < len(samples):
            decoded.append(_STORE.deserialize_cdr(samples[len(decoded)].payload.to_bytes(), type_name))
        return list(decoded)

    def statuses(self, pair: str) -> list[Any]:
        """Of a pair, of every `/diagnostics` that came."""
        arrays = self.messages("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        return [status for array in arrays for status in array.status if status.name == f"coec: {pair}_calibration"]

    def levels(self, pair: str) -> list[int]:
        """Of these."""
        return [int(status.level) for status in self.statuses(pair)]

    @property
    def level(self) -> int | None:
        """The latest of any pair."""
        arrays = self.messages("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")[-1:]
        return int(arrays[0].status[0].level) if arrays else None


@contextmanager
def listening(session: zenoh.Session, *topics: str, latched: tuple[str, ...] = ()) -> Iterator[Listener]:
    """Listens on domain 0 until the end of the block; `latched` topics with their history."""
    listener = Listener()

    def on(topic: str) -> zenoh.handlers.Callback[zenoh.Sample]:
        return zenoh.handlers.Callback(listener.samples[topic].append, indirect=False)

    plain = [session.declare_subscriber(f"0{topic}/*/*", on(topic)) for topic in topics]
    advanced: list[AdvancedSubscriber[None]] = [
        declare_advanced_subscriber(
            session,
            f"0{topic}/*/*",
            on(topic),
            history=HistoryConfig(detect_late_publishers=True, max_samples=100),
            recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        for topic in latched
    ]
    try:
        yield listener
    finally:
        for subscriber in plain:
            subscriber.undeclare()
        for one in advanced:
            one.undeclare()
