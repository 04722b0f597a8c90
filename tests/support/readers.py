"""Independent readers of what coec writes: recordings by `rosbags` and `mcap`, OpenMetrics text after its
specification (version 1.0.0), and a viewer, which is a client of the WebSocket subprotocol `foxglove.sdk.v1`.
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
import socket
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, Qos, QosDurability

SUBPROTOCOL = "foxglove.sdk.v1"
VIEWER_TIMEOUT_S = 60.0
TEXT, BINARY, CLOSE, PING, PONG = 0x1, 0x2, 0x8, 0x9, 0xA
MESSAGE_DATA = 1
"""First byte of a binary message that carries data: then subscription (u32), time (u64), payload; little endian."""


@dataclass
class Viewer:
    """One connection. Everything waits at most `PATIENCE_S`."""

    url: str
    info: dict[str, Any] = field(default_factory=dict)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    _waiting: bytearray = field(default_factory=bytearray)
    _topics: dict[int, str] = field(default_factory=dict)

    def __enter__(self) -> Viewer:
        address = urlsplit(self.url)
        assert address.hostname is not None
        self._socket = socket.create_connection((address.hostname, address.port or 80), VIEWER_TIMEOUT_S)
        self._handshake(address.netloc)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._socket.close()

    def subscribe(self, topics: Iterable[str]) -> None:
        """To topics, as soon as all of them are advertised."""
        requested = list(topics)
        while not set(requested) <= set(self.channels):
            self._control(*self._message())
        begin = len(self._topics)
        self._topics |= {begin + at: topic for at, topic in enumerate(requested)}
        subscriptions = [
            {"id": begin + at, "channelId": self.channels[topic]["id"]} for at, topic in enumerate(requested)
        ]
        self.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}).encode())

    def send(self, data: bytes, code: int = TEXT) -> None:
        """Send a message, whatever it is. Clients mask what they send; a mask of zeros leaves it as it is."""
        size = len(data)
        length = struct.pack("!B", 0x80 | size) if size < 126 else struct.pack("!BQ", 0x80 | 127, size)
        self._socket.sendall(bytes([0x80 | code]) + length + bytes(4) + data)

    def next(self) -> tuple[str, Any]:
        """The next message on any topic that was subscribed to: a document, or a protobuf message."""
        while True:
            kind, data = self._message()
            if kind == BINARY and data[0] == MESSAGE_DATA:
                (subscription,) = struct.unpack_from("<I", data, 1)
                topic = self._topics[subscription]
                return topic, self._decoded(topic, data[13:])
            self._control(kind, data)

    def next_on(self, topic: str) -> Any:
        """The next message on one topic."""
        while True:
            received, message = self.next()
            if received == topic:
                return message

    # --- messages ---------------------------------------------------------------------------------------------------

    def _control(self, kind: int, data: bytes) -> None:
        if kind != TEXT:
            return
        document = json.loads(data)
        if document["op"] == "serverInfo":
            self.info = document
        elif document["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in document["channels"]}

    def _decoded(self, topic: str, payload: bytes) -> Any:
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return json.loads(payload)
        message = message_class(channel["schemaName"], base64.b64decode(channel["schema"]))()
        message.ParseFromString(payload)
        return message

    # --- RFC 6455 ---------------------------------------------------------------------------------------------------

    def _handshake(self, host: str) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            "GET / HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: {SUBPROTOCOL}", "", "",
        )  # fmt: skip
        self._socket.sendall("\r\n".join(lines).encode())
        while b"\r\n\r\n" not in self._waiting:
            self._receive()
        head, _, rest = bytes(self._waiting).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101"), head
        self._waiting = bytearray(rest)

    def _message(self) -> tuple[int, bytes]:
        """The next whole message; pings are answered on the way."""
        whole, kind = b"", 0
        while True:
            first, second = self._read(2)
            length = second & 0x7F
            if length >= 126:
                length = int.from_bytes(self._read(2 if length == 126 else 8), "big")
            data = self._read(length)
            code = first & 0x0F
            if code == PING:
                self.send(data, PONG)
            elif code == CLOSE:
                raise EOFError("the server has closed the connection")
            elif code != PONG:
                kind, whole = code or kind, whole + data
                if first & 0x80:
                    return kind, whole

    def _read(self, count: int) -> bytes:
        while len(self._waiting) < count:
            self._receive()
        taken = bytes(self._waiting[:count])
        del self._waiting[:count]
        return taken

    def _receive(self) -> None:
        data = self._socket.recv(2**20)
        if not data:
            raise EOFError("the server has closed the connection")
        self._waiting += data


def message_class(name: str, schema: bytes) -> Any:
    """The class of a message, from a serialised FileDescriptorSet."""
    files = descriptor_pb2.FileDescriptorSet.FromString(schema)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"
LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\["\\n])*)"')
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|[+-]?Inf|NaN")
SAMPLE = re.compile(rf"({NAME})(\{{(.*)\}})? (\S+)")
SUFFIXES = {
    "counter": {"_total"},
    "gauge": {""},
    "histogram": {"_bucket", "_count", "_sum"},
    "info": {"_info"},
    "stateset": {""},
}


class MalformedError(AssertionError):
    """This is no OpenMetrics text."""


@dataclass
class Family:
    """One family; `samples` by suffix and labels."""

    name: str
    kind: str = "unknown"
    unit: str = ""
    help: str | None = None
    samples: dict[tuple[str, tuple[tuple[str, str], ...]], float] = field(default_factory=dict)

    def value(self, suffix: str = "", **labels: str) -> float:
        """Of the one sample with these labels."""
        return self.samples[suffix, tuple(sorted(labels.items()))]


def _require(condition: object, why: str) -> None:
    if not condition:
        raise MalformedError(why)


def parse_open_metrics(text: str) -> dict[str, Family]:
    """The families by their names."""
    _require(text.endswith("# EOF\n"), "the text does not end with # EOF")
    families: dict[str, Family] = {}
    current: Family | None = None
    for line in text.removesuffix("# EOF\n").splitlines():
        _require(line and line == line.strip(), f"blanks around a line: {line!r}")
        if line.startswith("#"):
            parts = line.split(" ", 3)
            _require(len(parts) == 4 and parts[0] == "#" and parts[1] in ("TYPE", "UNIT", "HELP"), line)
            _, what, name, rest = parts
            _require(re.fullmatch(NAME, name), f"{name} is no name")
            if current is None or current.name != name:
                _require(name not in families, f"the family {name} is told in two places")
                current = families[name] = Family(name)
            _require(not current.samples, f"{what} of {name} after its samples")
            _describe(current, what, rest)
        else:
            _require(current is not None, f"a sample before its family: {line}")
            assert current is not None
            _add_sample(current, line)
    for family in families.values():
        _require(family.kind in SUFFIXES, f"the type of {family.name}")
        if family.kind == "histogram":
            _check_histogram(family)
    names = [family.name + suffix for family in families.values() for suffix in SUFFIXES[family.kind]]
    _require(len(names) == len(set(names)), "two families have a sample name in common")
    return families


def _describe(family: Family, what: str, rest: str) -> None:
    if what == "TYPE":
        _require(family.kind == "unknown" and rest in SUFFIXES, f"TYPE of {family.name}")
        family.kind = rest
    elif what == "UNIT":
        _require(not family.unit and family.name.endswith(f"_{rest}"), f"UNIT of {family.name}")
        family.unit = rest
    else:
        _require(family.help is None and not re.search(r'(?<!\\)"|\\[^n\\"]', rest), f"HELP of {family.name}")
        family.help = rest


def _add_sample(family: Family, line: str) -> None:
    match = SAMPLE.fullmatch(line)
    _require(match, f"no sample: {line}")
    assert match is not None
    name, braces, inside, number = match.groups()
    _require(name.startswith(family.name), f"{name} stands below {family.name}")
    suffix = name.removeprefix(family.name)
    _require(suffix in SUFFIXES[family.kind], f"{name} in a {family.kind}")
    labels = _labels(inside or "", line) if braces else ()
    _require(NUMBER.fullmatch(number), f"no number: {line}")
    value = float(number.replace("Inf", "inf"))
    _require((suffix, labels) not in family.samples, f"told twice: {line}")
    if suffix in ("_total", "_bucket", "_count"):
        _require(value >= 0 and math.isfinite(value), f"a count below zero or without end: {line}")
    if suffix in ("_bucket", "_count"):
        _require(value == int(value), f"no whole number: {line}")
    if family.kind == "info":
        _require(value == 1, line)
    if family.kind == "stateset":
        _require(value in (0, 1) and family.name in dict(labels), line)
    family.samples[suffix, labels] = value


def _labels(inside: str, line: str) -> tuple[tuple[str, str], ...]:
    matches = list(LABEL.finditer(inside))
    _require(",".join(match.group() for match in matches) == inside and matches, f"labels: {line}")
    names = [match[1] for match in matches]
    _require(len(names) == len(set(names)), f"a label twice: {line}")
    return tuple(sorted((match[1], match[2]) for match in matches))


def _check_histogram(family: Family) -> None:
    groups: dict[tuple[tuple[str, str], ...], list[tuple[float, float]]] = {}
    for (suffix, labels), value in family.samples.items():
        own = tuple(item for item in labels if item[0] != "le")
        groups.setdefault(own, [])
        if suffix == "_bucket":
            bounds = dict(labels)["le"]
            _require(bounds == "+Inf" or re.fullmatch(r"\d+\.\d+(e-\d+)?|\d+e-\d+|\d+", bounds), f"le={bounds}")
            groups[own].append((float(bounds.replace("Inf", "inf")), value))
    for own, buckets in groups.items():
        bounds_s, counts = [bound for bound, _ in buckets], [count for _, count in buckets]
        _require(bounds_s == sorted(bounds_s) and bounds_s[-1:] == [math.inf], f"buckets of {family.name}{own}")
        _require(counts == sorted(counts), f"buckets of {family.name}{own} do not add up")
        _require(family.samples["_count", own] == counts[-1], f"the count of {family.name}{own} is not its last bucket")
        _require(family.samples["_sum", own] >= 0, f"the sum of {family.name}{own}")


@dataclass(frozen=True)
class RecordingContents:
    """What they agree on: types and numbers of messages by topic, and how each topic is compressed.

    Attributes:
        first: the first message of each topic of ROS, as rosbags decodes it.
        latched: topics that are kept for whoever comes later.
        documents: the messages that are JSON, by topic.
        packed: topics in whose chunks something is compressed.
    """

    types: dict[str, str]
    counts: dict[str, int]
    first: dict[str, Any]
    latched: set[str]
    documents: dict[str, list[Any]]
    packed: set[str]


def read_recording(path: Path) -> RecordingContents:
    """Every message of every channel, read by rosbags and by mcap with mcap_ros2, CRCs and all; they have to agree."""
    types, counts, documents, channels = _by_mcap(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    packed = {
        channels[number]
        for index in summary.chunk_indexes
        if index.compression
        for number in index.message_index_offsets
    }
    first: dict[str, Any] = {}
    seen: dict[str, int] = {}
    latched: set[str] = set()
    with AnyReader([path]) as reader:
        ros = [one for one in reader.connections if one.topic in types]
        for connection in ros:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            (profile,) = connection.ext.offered_qos_profiles
            assert isinstance(profile, Qos)
            if profile.durability is QosDurability.TRANSIENT_LOCAL:
                latched.add(connection.topic)
        for connection, _, data in reader.messages(ros):
            message = reader.deserialize(data, connection.msgtype)
            first.setdefault(connection.topic, message)
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
    assert seen == {topic: counts[topic] for topic in types}, "the two read different messages"
    return RecordingContents(types, counts, first, latched, documents, packed)


def _by_mcap(path: Path) -> tuple[dict[str, str], dict[str, int], dict[str, list[Any]], dict[int, str]]:
    decoders = DecoderFactory()
    types: dict[str, str] = {}
    counts: dict[str, int] = {}
    documents: dict[str, list[Any]] = {}
    channels: dict[int, str] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            channels[channel.id] = channel.topic
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            decoder = decoders.decoder_for(channel.message_encoding, schema)
            if channel.message_encoding == "json":
                documents.setdefault(channel.topic, []).append(json.loads(message.data))
                continue
            assert decoder is not None, f"{channel.topic} is of no known encoding"
            assert schema is not None
            decoder(message.data)
            types[channel.topic] = schema.name
    return types, counts, documents, channels
