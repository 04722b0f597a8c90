"""Publishes the messages of a recording on ROS 2 topics, with the keys, tokens and attachments of a ROS node."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Final, Literal

import zenoh
from pydantic import TypeAdapter, ValidationError

from coec.adapters.ros import messages
from coec.adapters.ros.topics import TopicMessage, qos_of
from coec.adapters.ros.wire.dialect import Dialect
from coec.adapters.ros.wire.rmw_zenoh import Node, RmwZenoh
from coec.adapters.ros.wire.ros2dds import Ros2dds
from coec.adapters.zenoh.cadence import Played, paced
from coec.adapters.zenoh.ros_publisher import RosNode, RosPublisher, RosPublishers
from coec.config import TopicName

Middleware = Literal["rmw_zenoh", "ros2dds"]

NODE: Final = "coec_play"

TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,127}/msg/[A-Za-z][A-Za-z0-9]{0,127}")
"""Full name of a message type (rosidl_parser, definition.py)."""

_TOPIC: Final = TypeAdapter[str](TopicName)

MATCHING_POLL_S: Final = 0.05
"""Pause between two looks for subscribers."""


def dialect_of(middleware: Middleware, session: zenoh.Session, domain: int, namespace: str) -> Dialect:
    """The dialect of a player in a session: that of an rmw_zenoh node in a domain, or of a bridge with a namespace."""
    name = str(session.info.zid())
    if middleware == "ros2dds":
        return Ros2dds(name, namespace)
    return RmwZenoh(Node(domain, name, 0, "/", NODE), messages.type_hash)


def is_playable(middleware: Middleware, topic: str, type_name: str) -> bool:
    """Whether a topic has a key. Topic and type must be valid ROS names, since a file may hold any text and a key with
    `*` is none. For rmw_zenoh the type must also be one of ROS's own, as its key holds the hash of the type."""
    try:
        _TOPIC.validate_python(topic)
    except ValidationError:
        return False
    return TYPE.fullmatch(type_name) is not None and (middleware == "ros2dds" or messages.is_known(type_name))


class TopicPlayer:
    """Publishes on topics. The sender waits instead of dropping, so that only the receiver loses messages."""

    def __init__(self, session: zenoh.Session, dialect: Dialect, topics: Mapping[str, str]) -> None:
        """`topics`: types by name."""
        self._node = RosNode(session, dialect)
        self._all = RosPublishers(session, self._node)
        self._publishers: dict[str, RosPublisher] = {
            topic: self._all.publisher(topic, type_name, qos_of(topic), zenoh.CongestionControl.BLOCK)
            for topic, type_name in topics.items()
        }

    def wait_for_listener(self, topics: Iterable[str], timeout_s: float, stop: threading.Event) -> list[str]:
        """Wait until each of these topics has a subscriber, at most `timeout_s`. Returns the topics that still have
        none."""
        pending = list(topics)
        deadline_s = time.monotonic() + timeout_s
        while True:
            unmatched = [topic for topic in pending if not self._publishers[topic].has_subscribers]
            if not unmatched or time.monotonic() > deadline_s or stop.wait(MATCHING_POLL_S):
                return unmatched

    def play(
        self,
        items: Iterable[TopicMessage],
        rate: float,
        stop: threading.Event,
        on_sent: Callable[[TopicMessage, Played], None],
    ) -> Played:
        """Publishes every message on one of the player's topics when it is due, see `paced`; others are left out."""
        ours = (message for message in items if message.topic in self._publishers)
        return paced(ours, rate, stop, self._send, on_sent, Played(Counter()))

    def close(self) -> None:
        """Withdraws tokens and publishers."""
        self._all.close()
        self._node.close()

    def _send(self, message: TopicMessage) -> tuple[str, int]:
        self._publishers[message.topic].put(message.data, time.time_ns())
        return message.topic, len(message.data)
