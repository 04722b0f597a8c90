"""The ROS 2 side of a Zenoh session: its own node with publishers, which ROS tools list and ROS nodes read, and the
publishers, topics and types of other nodes, read from liveliness tokens.

Anybody who reaches the router may declare tokens. Tokens that describe no publisher, and those beyond `MAX_PUBLISHERS`,
are counted and left out.

Checked on the wire against rmw_zenoh_cpp 0.6.7. Encodings stay unset, as ROS nodes leave them.
"""

import logging
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from itertools import count
from typing import cast

import zenoh
from zenoh.ext import AdvancedPublisher, CacheConfig, MissDetectionConfig, declare_advanced_publisher

from coec.config import AnyStreamConfig, Config, StreamConfig
from coec.io.ros import messages, wire_format
from coec.io.ros.messages import type_hash
from coec.io.ros.wire_format import SENSOR_DATA, STATIC_LISTENER, Dialect, Node, Publisher, Qos, RmwZenoh, Ros2dds
from coec.io.zenoh.bus import StreamInput, input_of
from coec.schemas.keys import NODE, TF_STATIC, ros_name

_log = logging.getLogger(__name__)

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
        kinds = " or ".join(dict.fromkeys(name.rpartition("/")[2] for name in types))
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
            _log.exception("a liveliness token could not be read")

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
        return wire_format.PUBLISHER_TOKENS, lambda token: wire_format.bridge_publisher(token, config.ros.namespace)
    return wire_format.publisher_tokens(config.ros.domain), wire_format.rmw_publisher


def dialect_of(config: Config, session: str) -> Dialect | None:
    """The dialect of a session with this Zenoh id, hexadecimal, towards the vehicle's ROS; None without ROS."""
    match config.middleware:
        case "rmw_zenoh":
            return RmwZenoh(Node(config.ros.domain, session, 0, f"/{ros_name(config.vehicle)}", NODE), type_hash)
        case "ros2dds":
            return Ros2dds(session, config.ros.namespace)
        case "native":
            return None


def has_subscribers(publisher: zenoh.Publisher) -> bool:
    """Whether somebody subscribes to the publisher's key."""
    # The stubs of eclipse-zenoh 1.10 declare a bool, but it is a `MatchingStatus` object, which is always truthy.
    return cast("zenoh.MatchingStatus", publisher.matching_status).matching


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
        if self.node is None or topic is None or type_name not in messages.known_types():
            return plain  # a token needs the hash of the definition
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
