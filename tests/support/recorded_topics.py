"""Publishers that keep what is put on them."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rosbags.typesys import Stores, get_typestore

from coec.io.ros.wire_format import Qos

_STORE = get_typestore(Stores.ROS2_JAZZY)
TIMEOUT_S = 20.0


@dataclass
class RetainedTopic:
    """`RosPublisher`, without a session."""

    type_name: str
    qos: Qos
    has_subscribers: bool = True
    closed: bool = False
    _received: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)

    def put(self, payload: bytes, source_ns: int) -> None:
        assert not self.closed
        assert source_ns > 0
        self._received.put(_STORE.deserialize_cdr(payload, self.type_name))

    def next(self) -> Any:
        """The next message, decoded by a reader that is not ours; waits for it."""
        return self._received.get(timeout=TIMEOUT_S)

    def rest(self) -> Sequence[Any]:
        """Whatever else has come."""
        return [self._received.get() for _ in range(self._received.qsize())]


@dataclass
class RetainedTopics:
    """`RosPublishers`, without a session."""

    topics: dict[str, RetainedTopic] = field(default_factory=dict)

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RetainedTopic:
        assert topic not in self.topics
        self.topics[topic] = RetainedTopic(type_name, qos)
        return self.topics[topic]

    def close(self) -> None:
        for topic in self.topics.values():
            topic.closed = True
