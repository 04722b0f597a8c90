"""A session on a vehicle that speaks ROS 2, or does not: the node that it is there, and what it sees of the others."""

from __future__ import annotations

from dataclasses import replace

import zenoh

from coec.adapters.ros.dialects import dialect_of
from coec.adapters.ros.wire.qos import SENSOR_DATA
from coec.adapters.zenoh.inputs import Input, input_of
from coec.adapters.zenoh.ros_publisher import RosNode
from coec.adapters.zenoh.ros_topics import RosTopics, Topics
from coec.config import AnyStreamConfig, Config


class RosSide:
    """Of one session.

    Attributes:
        node: None where the vehicle does not speak ROS.
    """

    def __init__(self, session: zenoh.Session, config: Config) -> None:
        """Be a node, and follow who publishes what."""
        dialect = dialect_of(config, str(session.info.zid()))
        self._config = config
        self.node = None if dialect is None else RosNode(session, dialect)
        self._topics = None if dialect is None else RosTopics(session, config)

    def input_of(self, stream: AnyStreamConfig) -> Input:
        """How to listen to a stream, with the token by which nodes and tools of ROS see who listens."""
        plain = input_of(stream, self._config)
        if self.node is None or stream.topic is None:
            return plain
        number = self.node.number()
        token = self.node.dialect.subscriber_token(number, stream.topic, stream.assumed_type, SENSOR_DATA)
        return replace(plain, token=token)

    def topics(self) -> Topics:
        """What is published now. Any thread."""
        return Topics() if self._topics is None else self._topics.now()

    def close(self) -> None:
        """Be nobody there any more."""
        if self._topics is not None:
            self._topics.close()
        if self.node is not None:
            self.node.close()
