"""rmw_zenoh: keys of topics, liveliness tokens, attachments.

Checked on the wire against rmw_zenoh_cpp 0.6.7 (Kilted), in both directions; the differences of Lyrical are taken from
its source (0.10.5).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import xxhash

from coec.adapters.ros.wire.publisher import Publisher
from coec.adapters.ros.wire.qos import Qos
from coec.errors import UsageError

TOKENS: Final = "@ros2_lv"
"""First chunk of all liveliness tokens; a chunk that starts with `@` is not matched by `**`."""

HASHLESS: Final = "TypeHashNotSupported"
"""Humble writes this in place of the hash of the type."""

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
