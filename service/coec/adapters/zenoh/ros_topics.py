"""The ROS publishers on a vehicle, read from liveliness tokens: their nodes, topics and types.

Anybody who reaches the router may declare tokens. Tokens that describe no publisher, and those beyond `MAX_PUBLISHERS`,
are counted and left out.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

import zenoh

from coec.adapters.ros.wire import rmw_zenoh, ros2dds
from coec.adapters.ros.wire.publisher import Publisher
from coec.config import Config

_topic_log = logging.getLogger(__name__)

MAX_PUBLISHERS = 4096
"""Most publishers that are kept, 2 MB: twenty times those of a large vehicle."""

OWN = "/coec/"
"""Topics below this are published by coec services themselves, so that they are no input streams."""

SHOWN = 8
"""Most topics that a sentence names; of the others it gives the number."""


@dataclass(frozen=True, slots=True)
class RosTopicList:
    """Publishers at one moment.

    Attributes:
        left_out: number of tokens that describe no publisher (`malformed`), or one too many (`too_many`).
    """

    publishers: tuple[Publisher, ...] = ()
    left_out: Counter[str] = field(default_factory=Counter)

    def of(self, topic: str) -> tuple[Publisher, ...]:
        """The publishers of a topic."""
        return tuple(one for one in self.publishers if one.topic == topic)

    def types(self) -> dict[str, tuple[str, ...]]:
        """The types of each topic; topics and types are sorted by name."""
        types_by_topic: dict[str, set[str]] = {}
        for one in self.publishers:
            types_by_topic.setdefault(one.topic, set()).add(one.type_name)
        return {topic: tuple(sorted(types_by_topic[topic])) for topic in sorted(types_by_topic)}

    def nodes_of(self, gids: Iterable[bytes]) -> tuple[str, ...]:
        """Names of the nodes whose publishers have these ids, as far as known."""
        requested = frozenset(gids)
        return tuple(sorted({one.node for one in self.publishers if one.node and one.gid in requested}))

    def absent(self, topic: str, types: Collection[str]) -> str | None:
        """None if somebody publishes the topic; otherwise a sentence that lists the topics of these types instead."""
        if self.of(topic):
            return None
        there = self.types()
        fitting = [name for name, known in there.items() if not set(known).isdisjoint(types)]
        if fitting:
            return f"no publisher of {topic}; there are: {listed(fitting)}"
        kinds = " or ".join(name.rpartition("/")[2] for name in types)
        return f"no publisher of {topic}; of {len(there)} topics that are there none is of type {kinds}"


def listed(names: Collection[str]) -> str:
    """The first names, and how many more there are."""
    shown = ", ".join(list(names)[:SHOWN])
    return shown if len(names) <= SHOWN else f"{shown} and {len(names) - SHOWN} more"


class RosTopicMonitor:
    """Follows the tokens of publishers, except those of coec services. `now` may be called from any thread."""

    def __init__(self, session: zenoh.Session, config: Config) -> None:
        """Starts to follow. Tokens that exist already arrive like new ones, milliseconds after a router answers."""
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        self._left_out: Counter[str] = Counter()
        self._changed = True
        self._now = RosTopicList()
        tokens, self._read = _tokens_of(config)
        self._subscriber: zenoh.Subscriber[None] | None = session.liveliness().declare_subscriber(
            tokens, zenoh.handlers.Callback(self._receive, indirect=False), history=True
        )

    def now(self) -> RosTopicList:
        """The publishers that exist now."""
        with self._lock:
            if self._changed:
                self._now = RosTopicList(tuple(self._publishers.values()), self._left_out.copy())
                self._changed = False
            return self._now

    def close(self) -> None:
        """Stop following."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            self._take(str(sample.key_expr), there=sample.kind == zenoh.SampleKind.PUT)
        except Exception:
            _topic_log.exception("a liveliness token could not be read")

    def _take(self, token: str, *, there: bool) -> None:
        publisher = self._read(token) if there else None
        with self._lock:
            if not there:
                self._changed |= self._publishers.pop(token, None) is not None
                return
            self._changed = True
            if publisher is None:
                self._left_out["malformed"] += 1
            elif publisher.topic.startswith(OWN):
                return
            elif len(self._publishers) >= MAX_PUBLISHERS:
                self._left_out["too_many"] += 1
            else:
                self._publishers[token] = publisher


def _tokens_of(config: Config) -> tuple[str, Callable[[str], Publisher | None]]:
    """The key expression of publishers' tokens, and the function that reads one."""
    if config.middleware == "ros2dds":
        return ros2dds.PUBLISHER_TOKENS, lambda token: ros2dds.bridge_publisher(token, config.ros.namespace)
    return rmw_zenoh.publisher_tokens(config.ros.domain), rmw_zenoh.rmw_publisher
