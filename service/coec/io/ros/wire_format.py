"""Wire format of ROS 2 on Zenoh, without a session: quality of service, keys of topics, liveliness tokens of
publishers and attachments of messages, as rmw_zenoh and zenoh-bridge-ros2dds write them.

Source: `liveliness_utils.cpp` of rmw_zenoh 0.6.7, checked against it on the wire.

Checked on the wire against rmw_zenoh_cpp 0.6.7 (Kilted), in both directions; the differences of Lyrical are taken from
its source (0.10.5).

Taken from the source of zenoh-plugin-ros2dds 1.10.0.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import xxhash

from coec.errors import UsageError

DEFAULT_DEPTH = 42
"""The depth that rmw_zenoh leaves out of the text."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Keep last `depth`; deadline, lifespan and liveliness are not set."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH

    @property
    def text(self) -> str:
        """`reliability:durability:history,depth:deadline:lifespan:liveliness`; defaults are left empty."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


SENSOR_DATA = Qos(reliable=False, depth=5)
"""`rmw_qos_profile_sensor_data`, for subscribers of sensors."""

STATIC = Qos(transient_local=True, depth=1)
"""For publishers of `/tf_static`: late subscribers get the last message (tf2_ros/qos.hpp, StaticBroadcasterQoS)."""

STATIC_LISTENER = Qos(transient_local=True, depth=100)
"""For subscribers of `/tf_static`: the last message of up to 100 publishers (tf2_ros/qos.hpp, StaticListenerQoS)."""


class Dialect(Protocol):
    """How one session speaks to ROS 2. `topic` begins with `/`; `type_name` is in ROS form
    (`sensor_msgs/msg/Image`)."""

    @property
    def node_token(self) -> str | None:
        """Liveliness token of the session's node; None if sessions are no nodes."""

    def key(self, topic: str, type_name: str) -> str:
        """The Zenoh key of a topic."""

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """Liveliness token of a publisher; `number` counts the session's entities."""

    def subscriber_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str | None:
        """Liveliness token of a subscriber; None if subscribing is enough."""

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """Attachment of the `sequence`-th message (from 1) of the publisher with `token`; `source_ns` is the sender's
        wall clock. None: no attachment."""


@dataclass(frozen=True, slots=True)
class Publisher:
    """`topic` and `type_name` in ROS form.

    Attributes:
        node: full name of its node; None if it is behind a bridge.
        gid: id of the publisher in its messages; None if its messages have none.
    """

    topic: str
    type_name: str
    node: str | None
    gid: bytes | None


TOKENS: Final = "@ros2_lv"
"""First chunk of all liveliness tokens; a chunk that starts with `@` is not matched by `**`."""

CPU_BACKEND: Final = "/backends:cpu:"
"""Suffix of a subscriber's token. Without it Lyrical sends messages with large arrays to a key specific to the
token."""

CPU_KEY: Final = "/_buf_cpu"
"""Suffix of a topic's key to which Lyrical's publishers send messages with large arrays for subscribers with
`CPU_BACKEND`."""

MAX_RMW_TOKEN: Final = 1024
"""Most characters of a token that is read; tokens of real nodes have some 200."""

_ATTACHMENT: Final = struct.Struct("<qqB16s")

MAX_ATTACHMENT: Final = _ATTACHMENT.size
"""Size of an attachment in bytes; anything longer is not one."""

_RMW_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_NODE: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+|/")

_RMW_TYPE: Final = re.compile(r"([A-Za-z][A-Za-z0-9_]{0,127})::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]{0,127})_")


@dataclass(frozen=True, slots=True)
class TopicKey:
    """The key of a topic: `<domain>/<topic>/<type>/<hash>`. `topic` begins with `/`; `type_name` is in ROS form
    (`sensor_msgs/msg/Image`)."""

    domain: int
    topic: str
    type_name: str
    type_hash: str

    @property
    def key(self) -> str:
        """The Zenoh key."""
        return f"{self.domain}/{self.topic.strip('/')}/{dds_type(self.type_name)}/{self.type_hash}"

    @classmethod
    def parse(cls, key: str) -> TopicKey:
        """The inverse of `key`; Lyrical's suffix (`/_buf_cpu`) is dropped.

        Raises:
            UsageError: not the key of a topic.
        """
        chunks = key.removesuffix(CPU_KEY).split("/")
        if len(chunks) < 4 or not chunks[0].isdecimal() or len(chunks[0]) > 3:
            raise UsageError("not the key of a topic of rmw_zenoh: expected domain/topic/type/hash")
        return cls(int(chunks[0]), "/" + "/".join(chunks[1:-2]), ros_type(chunks[-2]), chunks[-1])


def topic_expressions(domain: int, topic: str) -> tuple[str, str]:
    """Key expressions that match the topic with any type, and no other topic. The second is for messages with large
    arrays from Lyrical's publishers."""
    key = f"{domain}/{topic.strip('/')}/*/*"
    return key, key + CPU_KEY


def dds_type(type_name: str) -> str:
    """`sensor_msgs/msg/Image` as `sensor_msgs::msg::dds_::Image_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(chunk: str) -> str:
    """The inverse of `dds_type`.

    Raises:
        UsageError: not the name of a type.
    """
    match = _RMW_TYPE.fullmatch(chunk)
    if match is None:
        raise UsageError("not a type of rmw_zenoh: expected package::msg::dds_::Name_")
    return "/".join(match.groups())


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a session. `namespace` begins with `/`; `session` is the Zenoh id, hexadecimal."""

    domain: int
    session: str
    number: int
    namespace: str
    name: str

    @property
    def token(self) -> str:
        """Its liveliness token."""
        return f"{TOKENS}/{self.domain}/{self.session}/{self.number}/{self.number}/NN/%/{self._named}"

    def publisher(self, number: int, topic: TopicKey, qos: Qos) -> str:
        """The token of a publisher of this node; `number` counts the session's entities."""
        return self._endpoint("MP", number, topic, qos)

    def subscriber(self, number: int, topic: TopicKey, qos: Qos) -> str:
        """The token of a subscriber of this node. It receives large arrays on a key shared by all subscribers."""
        return self._endpoint("MS", number, topic, qos) + CPU_BACKEND

    def _endpoint(self, kind: str, number: int, topic: TopicKey, qos: Qos) -> str:
        described = f"{mangled(topic.topic)}/{dds_type(topic.type_name)}/{topic.type_hash}/{qos.text}"
        return f"{TOKENS}/{self.domain}/{self.session}/{self.number}/{number}/{kind}/%/{self._named}/{described}"

    @property
    def _named(self) -> str:
        return f"{mangled(self.namespace)}/{self.name}"


def publisher_tokens(domain: int) -> str:
    """A key expression that matches the tokens of all publishers."""
    return f"{TOKENS}/{domain}/*/*/*/MP/**"


def rmw_publisher(token: str) -> Publisher | None:
    """The publisher that a token describes; None if it describes none, or one that is impossible in ROS."""
    chunks = token.split("/") if len(token) <= MAX_RMW_TOKEN else []
    if len(chunks) < 13 or chunks[0] != TOKENS or chunks[5] != "MP":
        return None
    topic, described = unmangled(chunks[9]), chunks[10]
    node = f"{unmangled(chunks[7]).rstrip('/')}/{chunks[8]}"
    if not (_RMW_TOPIC.fullmatch(topic) and _NODE.fullmatch(node) and _RMW_TYPE.fullmatch(described)):
        return None
    return Publisher(topic, ros_type(described), node, gid_of(token))


@dataclass(frozen=True, slots=True)
class RmwZenoh:
    """The dialect of a session that is one node; `type_hash` returns the RIHS01 hash of a type by its name."""

    node: Node
    type_hash: Callable[[str], str]

    @property
    def node_token(self) -> str:
        """See `Dialect`."""
        return self.node.token

    def key(self, topic: str, type_name: str) -> str:
        """See `Dialect`."""
        return self._topic(topic, type_name).key

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """See `Dialect`."""
        return self.node.publisher(number, self._topic(topic, type_name), qos)

    def subscriber_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """See `Dialect`."""
        return self.node.subscriber(number, self._topic(topic, type_name), qos)

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes:
        """See `Dialect`."""
        return MessageAttachment(sequence, source_ns, gid_of(token)).packed

    def _topic(self, topic: str, type_name: str) -> TopicKey:
        return TopicKey(self.node.domain, topic, type_name, self.type_hash(type_name))


def mangled(name: str) -> str:
    """A ROS name as one chunk of a key."""
    return name.replace("/", "%")


def unmangled(chunk: str) -> str:
    """The inverse of `mangled`."""
    return chunk.replace("%", "/")


@dataclass(frozen=True, slots=True)
class MessageAttachment:
    """What comes with each message: its number (from 1), the sender's wall clock, and the publisher's id."""

    sequence: int
    source_ns: int
    gid: bytes

    @property
    def packed(self) -> bytes:
        """33 bytes. rmw_zenoh drops a message without them."""
        return _ATTACHMENT.pack(self.sequence, self.source_ns, len(self.gid), self.gid)

    @classmethod
    def parse(cls, attachment: bytes | None) -> MessageAttachment | None:
        """The inverse of `packed`; None if the bytes are no attachment."""
        if attachment is None or len(attachment) != _ATTACHMENT.size:
            return None
        sequence, source_ns, length, gid = _ATTACHMENT.unpack(attachment)
        return cls(sequence, source_ns, gid) if length == len(gid) and sequence >= 0 else None


def gid_of(token: str) -> bytes:
    """The 16-byte id of a publisher, computed from its token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


SLASH: Final = "§"
"""Stands for `/` in a key or a type that is one chunk of a token."""

_BRIDGE_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_BRIDGE_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")


def topic_key(namespace: str, topic: str) -> str:
    """`[namespace/]topic`, without slashes at the ends."""
    return "/".join(part for part in (namespace.strip("/"), topic.strip("/")) if part)


@dataclass(frozen=True, slots=True)
class Ros2dds:
    """The dialect of a session beside a bridge. `session` is its Zenoh id, hexadecimal; `namespace` is that of the
    bridge, empty for none. Messages have no attachment."""

    session: str
    namespace: str

    @property
    def node_token(self) -> None:
        """None: bridges announce routes, not nodes."""
        return None

    def key(self, topic: str, type_name: str) -> str:
        """See `Dialect`; the type is not part of the key."""
        del type_name
        return topic_key(self.namespace, topic)

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """See `Dialect`. A session has one publisher per topic, so that the token has no number."""
        del number
        key, type_chunk = (name.replace("/", SLASH) for name in (self.key(topic, type_name), type_name))
        return f"@/{self.session}/@ros2_lv/MP/{key}/{type_chunk}/{qos_text(qos)}"

    def subscriber_token(self, number: int, topic: str, type_name: str, qos: Qos) -> None:
        """None: a bridge notices the subscription itself."""
        del number, topic, type_name, qos

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """None: the bridge reads no attachments."""
        del token, sequence, source_ns
        return None


PUBLISHER_TOKENS: Final = "@/*/@ros2_lv/MP/*/*/*"
"""A key expression that matches the tokens of all publishers, of every bridge."""

MAX_BRIDGE_TOKEN: Final = 1024
"""Most characters of a token that is read; tokens of real bridges have some 150."""


def bridge_publisher(token: str, namespace: str) -> Publisher | None:
    """The publisher behind a bridge that a token describes; None if it describes none, one of another namespace, or one
    that is impossible in ROS."""
    chunks = token.split("/") if len(token) <= MAX_BRIDGE_TOKEN else []
    if len(chunks) != 7 or chunks[0] != "@" or chunks[2:4] != ["@ros2_lv", "MP"]:
        return None
    key, type_name = (chunk.replace(SLASH, "/") for chunk in chunks[4:6])
    within = topic_key(namespace, "")
    topic = f"/{key}".removeprefix(f"/{within}" if within else "")
    if not (_BRIDGE_TOPIC.fullmatch(topic) and _BRIDGE_TYPE.fullmatch(type_name)):
        return None
    return Publisher(topic, type_name, None, None)


def qos_text(qos: Qos) -> str:
    """`keyed:reliability:durability:history,depth`, with the numbers of Cyclone DDS; ROS topics are keyless."""
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:0,{qos.depth}"
