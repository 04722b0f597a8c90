"""The wire between the service and its worker process: one socket pair, one msgpack map per message, sent in parts.

A process that dies may leave half a message. So sends and receives have a time limit, and neither end can block for
ever on the other.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

import msgpack

_BIN32 = struct.Struct(">BI")
_BIN32_CODE = 0xC6
"""Code of msgpack for a byte string with a length of 32 bits."""

LARGE_BYTES = 2**16
"""A byte string of at least this size is sent without being copied."""

END = b""
"""The part that ends a message."""

MAX_MESSAGE_BYTES = 2**30
"""Largest message, bytes. A frame is bounded by `LimitsConfig.max_message_bytes`, which is at most 1 GiB."""

TRANSFER_TIMEOUT_S = 10
"""Largest pause inside one transfer, s. The other end only has to read from its socket buffer."""


class MalformedMessageError(Exception):
    """What came over the wire is not a message; the text says why."""


class Link:
    """One end of the wire."""

    def __init__(self, descriptor: int) -> None:
        """Takes over the descriptor of a connected stream socket."""
        self._connection = Connection(descriptor)

    @classmethod
    def pair(cls) -> tuple[Link, socket.socket]:
        """A connected pair: our end, and the socket to hand to the child."""
        ours, theirs = socket.socketpair()
        limit = struct.pack("@ll", TRANSFER_TIMEOUT_S, 0)
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, option, limit)
        return cls(ours.detach()), theirs

    def send(self, message: dict[str, Any]) -> None:
        """Sends one message.

        Raises:
            OSError: the other end is gone, or does not read.
        """
        for part in _parts(message):
            self._connection.send_bytes(part)
        self._connection.send_bytes(END)

    def poll(self, timeout_s: float) -> bool:
        """Whether a message, or the end of the stream, can be received within `timeout_s`."""
        return self._connection.poll(timeout_s)

    def receive(self, max_bytes: int = MAX_MESSAGE_BYTES) -> dict[str, Any]:
        """The next message, of at most `max_bytes`; blocks until it is there.

        Raises:
            NoMessageError: what came is too large, not msgpack, or no map.
            OSError, EOFError: the other end is gone, or stopped in the middle of a message.
        """
        unpacker = msgpack.Unpacker(max_buffer_size=max_bytes)
        while part := self._part(max_bytes):
            try:
                unpacker.feed(part)
            except msgpack.BufferFull:
                raise MalformedMessageError(f"it is larger than {max_bytes} bytes") from None
        try:
            message = unpacker.unpack()
        except (ValueError, msgpack.UnpackException) as error:
            raise MalformedMessageError(f"it is not msgpack ({type(error).__name__})") from error
        if not isinstance(message, dict):
            raise MalformedMessageError("it is not a map")
        return message

    def _part(self, max_bytes: int) -> bytes:
        try:
            return self._connection.recv_bytes(max_bytes)
        except OSError:
            if not self._connection.readable:  # the library sets this when a part is too large
                raise MalformedMessageError(f"it is larger than {max_bytes} bytes") from None
            raise

    def close(self) -> None:
        """Closes this end; the other end reads the end of the stream."""
        self._connection.close()


def _parts(message: dict[str, Any]) -> Iterator[bytes]:
    """The message in msgpack, piece by piece. A large byte string is a piece by itself and is not copied. Only one
    packed entry of a lazy sequence is in memory at a time."""
    packer = msgpack.Packer(autoreset=False)

    def taken() -> bytes:
        packed: bytes = packer.bytes()
        packer.reset()
        return packed

    def add(value: Any) -> Iterator[bytes]:
        if isinstance(value, dict):
            packer.pack_map_header(len(value))
            for key, entry in value.items():
                packer.pack(key)
                yield from add(entry)
        elif isinstance(value, Sequence) and not isinstance(value, str | bytes | msgpack.ExtType):
            packer.pack_array_header(len(value))
            for entry in value:
                yield from add(entry)
        elif isinstance(value, bytes) and len(value) >= LARGE_BYTES:
            yield taken() + _BIN32.pack(_BIN32_CODE, len(value))
            yield value
        else:
            packer.pack(value)

    yield from add(message)
    if rest := taken():  # empty after a large byte string, but an empty part would end the message
        yield rest
