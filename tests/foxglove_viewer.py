"""A viewer: a client of the WebSocket subprotocol `foxglove.sdk.v1` (RFC 6455 by hand, messages by the schemas that the
server advertises), as Foxglove and Lichtblick are."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

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
