"""This session as a node of ROS 2, and its publishers: tokens that ROS's tools list, keys and attachments that its
nodes read.

Seen on the wire against rmw_zenoh_cpp 0.6.7. Encodings stay unset, as those of ROS's own.
"""

from __future__ import annotations

from itertools import count

import zenoh
from zenoh.ext import AdvancedPublisher, CacheConfig, MissDetectionConfig, declare_advanced_publisher

from coec.adapters.ros.wire.dialect import Dialect
from coec.adapters.ros.wire.qos import Qos
from coec.adapters.zenoh.matching import is_heard

HEARTBEAT_S = 0.5
"""How soon whoever missed the last message of a latched topic is told so; rmw_zenoh's own."""


class RosNode:
    """The node that a session is. It numbers the session's entities: all of them have to ask the same one."""

    def __init__(self, session: zenoh.Session, dialect: Dialect) -> None:
        self.dialect = dialect
        self._session = session
        self._numbers = count(1)  # 0 is the node
        self._token = None if dialect.node_token is None else self.hold(dialect.node_token)

    def number(self) -> int:
        """Of the next entity."""
        return next(self._numbers)

    def hold(self, token: str) -> zenoh.LivelinessToken:
        """Show a token until it is undeclared, or the session ends."""
        return self._session.liveliness().declare_token(token)

    def close(self) -> None:
        """Be no node any more; entities withdraw their own tokens, before."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None


class RosPublisher:
    """One publisher; each belongs to one thread."""

    def __init__(
        self,
        node: RosNode,
        token: str,
        publisher: zenoh.Publisher | AdvancedPublisher,
        liveliness: zenoh.LivelinessToken,
    ) -> None:
        self._dialect = node.dialect
        self._token = token
        self._publisher = publisher
        self._liveliness = liveliness
        self._sequence = count(1)

    @property
    def key(self) -> str:
        """Where it publishes."""
        return str(self._publisher.key_expr)

    @property
    def is_heard(self) -> bool:
        """Whether somebody subscribes now; one that keeps its messages speaks to whoever comes later, always."""
        return not isinstance(self._publisher, zenoh.Publisher) or is_heard(self._publisher)

    def put(self, payload: bytes, source_ns: int) -> None:
        """Publish a message in CDR; `source_ns` is the wall clock of whoever made it.

        Raises:
            zenoh.ZError: the session is closed.
        """
        attachment = self._dialect.attachment(self._token, next(self._sequence), source_ns)
        self._publisher.put(payload, attachment=attachment)

    def undeclare(self) -> None:
        """Withdraw it: the token first, so that nobody waits for what does not come any more."""
        self._liveliness.undeclare()
        self._publisher.undeclare()  # type: ignore[no-untyped-call]  # of zenoh.ext, whose stubs name no result


class RosPublishers:
    """All that a session publishes to ROS."""

    def __init__(self, session: zenoh.Session, node: RosNode) -> None:
        self._session = session
        self._node = node
        self._declared: list[RosPublisher] = []

    def publisher(
        self,
        topic: str,
        type_name: str,
        qos: Qos,
        congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.DROP,
    ) -> RosPublisher:
        """Declare a publisher. A transient local one keeps the last `qos.depth` messages for whoever comes later."""
        dialect = self._node.dialect
        key = dialect.key(topic, type_name)
        reliability = zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
        publisher: zenoh.Publisher | AdvancedPublisher
        if qos.transient_local:
            publisher = declare_advanced_publisher(
                self._session,
                key,
                congestion_control=congestion_control,
                reliability=reliability,
                cache=CacheConfig(qos.depth),
                sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                publisher_detection=True,
            )
        else:
            publisher = self._session.declare_publisher(
                key, congestion_control=congestion_control, reliability=reliability
            )
        token = dialect.publisher_token(self._node.number(), topic, type_name, qos)
        declared = RosPublisher(self._node, token, publisher, self._node.hold(token))
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        """Withdraw all of them."""
        while self._declared:
            self._declared.pop().undeclare()
