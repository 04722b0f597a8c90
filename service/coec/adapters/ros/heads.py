"""Reads what precedes the data in a CDR message, with bounds, before a decoder builds anything from it."""

from __future__ import annotations

import struct
from typing import Final

from coec.adapters.frames.incoming import MAX_FRAME_ID, Refusal
from coec.errors import DecodeError

MAX_CLOUD_FIELDS: Final = 64
"""Most fields of a cloud; drivers write up to about a dozen. The limit exists because each becomes a Python object."""

MAX_FIELD_NAME: Final = 256
"""Most bytes of the name of a field; drivers use up to some twenty."""

_ORDERS: Final = {b"\x00": ">", b"\x01": "<"}
"""Byte order by the second byte of the encapsulation (plain CDR)."""

_ENCAPSULATION: Final = 4
"""Bytes before the message; alignment counts from their end."""

_STAMP: Final = 8
"""Bytes of `std_msgs/Header.stamp`."""

_CHARACTER: Final = 4
"""Most bytes of a character in UTF-8."""


class MessageCursor:
    """A cursor that moves through a message from its beginning.

    Raises:
        DecodeError: `message_malformed`: not CDR, or the message ends before the requested value.
    """

    def __init__(self, payload: bytes) -> None:
        order = _ORDERS.get(payload[1:2])
        if order is None:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "not a message in CDR")
        self._payload = payload
        self._order = order
        self._at = _ENCAPSULATION

    def number(self) -> int:
        """The next uint32."""
        self._at += -(self._at - _ENCAPSULATION) % 4
        try:
            (value,) = struct.unpack_from(f"{self._order}I", self._payload, self._at)
        except struct.error as error:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head") from error
        self._at += 4
        return int(value)

    def skip(self, size: int) -> None:
        """Skips `size` bytes."""
        self._at += size

    def text(self, max_bytes: int, reason: Refusal, what: str) -> None:
        """Skips a string.

        Raises:
            DecodeError: with `reason`, if the string claims to be longer than `max_bytes`.
        """
        length = self.number()
        if length > max_bytes + 1:  # the zero behind it counts
            raise DecodeError(reason, f"{what} is longer than {max_bytes} bytes")
        self.skip(length)


def check_header(payload: bytes) -> MessageCursor:
    """Checks the `std_msgs/Header` at the beginning of a message. Returns the cursor behind it.

    Raises:
        DecodeError: `frame_id_invalid` or `message_malformed`.
    """
    head = MessageCursor(payload)
    head.skip(_STAMP)
    head.text(_CHARACTER * MAX_FRAME_ID, Refusal.FRAME_ID_INVALID, "the frame id")
    return head


def check_cloud_fields(payload: bytes) -> None:
    """Checks the fields of a `PointCloud2`.

    Raises:
        DecodeError: `cloud_fields`, `frame_id_invalid` or `message_malformed`.
    """
    head = check_header(payload)
    head.number()  # height
    head.number()  # width
    count = head.number()
    if count > MAX_CLOUD_FIELDS:
        raise DecodeError(Refusal.CLOUD_FIELDS, f"the cloud has more than {MAX_CLOUD_FIELDS} fields")
    for _ in range(count):
        head.text(MAX_FIELD_NAME, Refusal.CLOUD_FIELDS, "the name of a field")
        head.number()  # offset
        head.skip(1)  # datatype
        head.number()  # count
