"""Makes a session a ROS 2 node with publishers: its tokens are listed by ROS tools, its keys and attachments are read
by ROS nodes.

Checked on the wire against rmw_zenoh_cpp 0.6.7. Encodings stay unset, as ROS nodes leave them.
"""

from __future__ import annotations

import logging
from itertools import count

import zenoh
from zenoh.ext import AdvancedPublisher, CacheConfig, MissDetectionConfig, declare_advanced_publisher

from coec.adapters.ros.wire.dialect import Dialect
from coec.adapters.ros.wire.qos import Qos
from coec.adapters.zenoh.matching import has_subscribers

_log = logging.getLogger(__name__)

HEARTBEAT_S = 0.5
"""How soon a subscriber learns that it missed the last message of a latched topic; the value of rmw_zenoh."""


class RosNode:
    """The ROS node of a session. It numbers the session's entities, so that a session must have only one."""

    def __init__(self, session: zenoh.Session, dialect: Dialect) -> None:
        self.dialect = dialect
        self._session = session
        self._numbers = count(1)  # 0 is the node
        self._token = None if dialect.node_token is None else self.hold(dialect.node_token)

    def number(self) -> int:
        """Number of the next entity."""
        return next(self._numbers)

    def hold(self, token: str) -> zenoh.LivelinessToken:
        """Hold a token until it is undeclared or the session ends."""
        return self._session.liveliness().declare_token(token)

    def close(self) -> None:
        """Withdraw the node. Its entities must have withdrawn their own tokens before."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None


class RosPublisher:
    """One publisher; use it from one thread only."""

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
        """The key on which it publishes."""
        return str(self._publisher.key_expr)

    @property
    def has_subscribers(self) -> bool:
        """Whether somebody subscribes now; always True for a publisher that keeps messages for late subscribers."""
        return not isinstance(self._publisher, zenoh.Publisher) or has_subscribers(self._publisher)

    def put(self, payload: bytes, source_ns: int) -> None:
        """Publish a message in CDR; `source_ns` is the wall clock at which it was made. It is silently lost while there
        is no router, and after the session is closed."""
        attachment = self._dialect.attachment(self._token, next(self._sequence), source_ns)
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            _log.debug("a message of ROS could not be published", extra={"fields": {"why": str(error)}})

    def undeclare(self) -> None:
        """Withdraw it: the token first, so that nobody waits for more messages."""
        self._liveliness.undeclare()
        self._publisher.undeclare()  # type: ignore[no-untyped-call]  # the stubs of zenoh.ext name no result


class RosPublishers:
    """All ROS publishers of a session."""

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
        """Declare a publisher. A transient local one keeps the last `qos.depth` messages for late subscribers."""
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
