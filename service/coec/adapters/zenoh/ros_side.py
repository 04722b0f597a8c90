"""The ROS 2 side of a session, on vehicles with or without ROS: its own node, and the topics of other nodes."""

from __future__ import annotations

from dataclasses import replace

import zenoh

from coec.adapters.ros import messages
from coec.adapters.ros.dialects import dialect_of
from coec.adapters.ros.wire.qos import SENSOR_DATA, STATIC_LISTENER, Qos
from coec.adapters.zenoh.inputs import StreamInput, input_of
from coec.adapters.zenoh.ros_publisher import RosNode
from coec.adapters.zenoh.ros_topics import RosTopicList, RosTopicMonitor
from coec.config import AnyStreamConfig, Config, StreamConfig
from coec.schemas.ros_names import TF_STATIC


class RosSide:
    """The ROS side of one session.

    Attributes:
        node: None if the vehicle does not use ROS.
    """

    def __init__(self, session: zenoh.Session, config: Config) -> None:
        """Become a node and follow the publishers on the bus."""
        dialect = dialect_of(config, str(session.info.zid()))
        self._config = config
        self.node = None if dialect is None else RosNode(session, dialect)
        self._topics = None if dialect is None else RosTopicMonitor(session, config)

    def input_of(self, stream: AnyStreamConfig) -> StreamInput:
        """How to listen to a stream, with the token that shows the subscription to ROS nodes and tools."""
        return self._announced(input_of(stream, self._config), stream.topic, stream.assumed_type, SENSOR_DATA)

    def input_of_info(self, topic: str) -> StreamInput:
        """The same for a `CameraInfo` topic."""
        return self._announced(self._of_topic(topic), topic, messages.CAMERA_INFO, SENSOR_DATA)

    def input_of_static_transforms(self) -> StreamInput:
        """The same for `/tf_static`."""
        return self._announced(self._of_topic(TF_STATIC), TF_STATIC, messages.TF, STATIC_LISTENER)

    def _of_topic(self, topic: str) -> StreamInput:
        return input_of(StreamConfig(topic=topic), self._config)

    def _announced(self, plain: StreamInput, topic: str | None, type_name: str, qos: Qos) -> StreamInput:
        if self.node is None or topic is None:
            return plain
        return replace(plain, token=self.node.dialect.subscriber_token(self.node.number(), topic, type_name, qos))

    def topics(self) -> RosTopicList:
        """What is published now. May be called from any thread."""
        return RosTopicList() if self._topics is None else self._topics.now()

    def close(self) -> None:
        """Withdraw the node and stop following the publishers."""
        if self._topics is not None:
            self._topics.close()
        if self.node is not None:
            self.node.close()
