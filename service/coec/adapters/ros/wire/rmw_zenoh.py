"""rmw_zenoh: keys of topics, liveliness tokens, attachments.

Seen on the wire against rmw_zenoh_cpp 0.6.7 (Kilted), both directions; what Lyrical does otherwise was read in its
source (0.10.5).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Final

import xxhash

from coec.adapters.ros.wire.qos import Qos
from coec.errors import UsageError

TOKENS: Final = "@ros2_lv"
"""First chunk of all liveliness tokens; a chunk that starts with `@` is not matched by `**`."""

HASHLESS: Final = "TypeHashNotSupported"
"""Humble writes this where later ones write the hash of the type."""

CPU_BACKEND: Final = "/backends:cpu:"
"""Behind a subscriber's token: without it Lyrical sends messages with large arrays to a key of the token's own."""

CPU_KEY: Final = "/_buf_cpu"
"""Behind the key of a topic: there Lyrical's publishers put messages with large arrays for such subscribers."""

MAX_TOKEN: Final = 1024
"""Characters of a token that is read; those of real nodes have some 200."""

_ATTACHMENT: Final = struct.Struct("<qqB16s")

MAX_ATTACHMENT: Final = _ATTACHMENT.size
"""Bytes; a longer one is none."""

_TYPE: Final = re.compile(r"([A-Za-z][A-Za-z0-9_]{0,127})::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]{0,127})_")


@dataclass(frozen=True, slots=True)
class TopicKey:
    """Where a topic lies: `<domain>/<topic>/<type>/<hash>`. `topic` begins with `/`; `type_name` is ROS's own
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
        """The inverse; what Lyrical appends (`/_buf_cpu`) is left out.

        Raises:
            UsageError: not the key of a topic.
        """
        chunks = key.removesuffix(CPU_KEY).split("/")
        if len(chunks) < 4 or not chunks[0].isdecimal() or len(chunks[0]) > 3:
            raise UsageError("not the key of a topic of rmw_zenoh: expected domain/topic/type/hash")
        return cls(int(chunks[0]), "/" + "/".join(chunks[1:-2]), ros_type(chunks[-2]), chunks[-1])


def topic_expressions(domain: int, topic: str) -> tuple[str, str]:
    """Key expressions that match the topic in whatever type, and no other topic; the second one where Lyrical's
    publishers put messages with large arrays."""
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
    match = _TYPE.fullmatch(chunk)
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
        """The token of a subscriber of this node, which takes large arrays as everybody else's."""
        return self._endpoint("MS", number, topic, qos) + CPU_BACKEND

    def _endpoint(self, kind: str, number: int, topic: TopicKey, qos: Qos) -> str:
        described = f"{mangled(topic.topic)}/{dds_type(topic.type_name)}/{topic.type_hash}/{qos.text}"
        return f"{TOKENS}/{self.domain}/{self.session}/{self.number}/{number}/{kind}/%/{self._named}/{described}"

    @property
    def _named(self) -> str:
        return f"{mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher or subscriber that a token tells of."""

    kind: str
    node: str
    topic: TopicKey

    @classmethod
    def parse(cls, token: str) -> Endpoint | None:
        """What a token tells; None for nodes, services and whatever else is not an endpoint of a topic."""
        chunks = token.split("/")
        if len(token) > MAX_TOKEN or len(chunks) < 13 or chunks[0] != TOKENS or chunks[5] not in ("MP", "MS"):
            return None
        domain, topic, described, type_hash = chunks[1], chunks[9], chunks[10], chunks[11]
        if not domain.isdecimal() or len(domain) > 3 or _TYPE.fullmatch(described) is None:
            return None
        name = f"{unmangled(chunks[7]).rstrip('/')}/{chunks[8]}"
        return cls(chunks[5], name, TopicKey(int(domain), unmangled(topic), ros_type(described), type_hash))


def mangled(name: str) -> str:
    """A name of ROS as one chunk of a key."""
    return name.replace("/", "%")


def unmangled(chunk: str) -> str:
    """The inverse of `mangled`."""
    return chunk.replace("%", "/")


@dataclass(frozen=True, slots=True)
class Attachment:
    """What comes with each message: its number (from 1), the sender's wall clock, and who the publisher is."""

    sequence: int
    source_ns: int
    gid: bytes

    @property
    def packed(self) -> bytes:
        """33 bytes. Without them rmw_zenoh drops a message."""
        return _ATTACHMENT.pack(self.sequence, self.source_ns, len(self.gid), self.gid)

    @classmethod
    def parse(cls, attachment: bytes | None) -> Attachment | None:
        """The inverse; None where it is none."""
        if attachment is None or len(attachment) != _ATTACHMENT.size:
            return None
        sequence, source_ns, length, gid = _ATTACHMENT.unpack(attachment)
        return cls(sequence, source_ns, gid) if length == len(gid) and sequence >= 0 else None


def gid_of(token: str) -> bytes:
    """The 16 bytes by which a publisher is known, from its own token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
