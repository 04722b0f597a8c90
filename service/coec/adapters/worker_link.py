"""The wire between the service and its worker process: one socket pair, one msgpack map per message.

Both ends are ours, yet a dying end may leave half a message: sends and receives have a time limit, so that neither can
block for good on the other.
"""

from __future__ import annotations

import socket
import struct
from multiprocessing.connection import Connection
from typing import Any

import msgpack

MAX_MESSAGE_BYTES = 2**30
"""Largest message; a frame is bounded by `LimitsConfig.max_message_bytes`, which is at most 1 GiB."""

TRANSFER_TIMEOUT_S = 10
"""Largest pause inside one transfer; the other end only has to read from its socket buffer."""


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
        """Send one message.

        Raises:
            OSError: the other end is gone, or does not read.
        """
        self._connection.send_bytes(msgpack.packb(message))

    def poll(self, timeout_s: float) -> bool:
        """Whether a message, or the end of the stream, can be received within `timeout_s`."""
        return self._connection.poll(timeout_s)

    def receive(self) -> dict[str, Any]:
        """The next message; blocks until it is there.

        Raises:
            OSError, EOFError: the other end is gone, or stopped in the middle of a message.
        """
        message = msgpack.unpackb(self._connection.recv_bytes(MAX_MESSAGE_BYTES), max_bin_len=MAX_MESSAGE_BYTES)
        if not isinstance(message, dict):
            raise OSError("the message is not a map")
        return message

    def close(self) -> None:
        """Close this end; the other end reads the end of the stream."""
        self._connection.close()
