"""The last word of a pair: what whoever looks after many vehicles needs of each, in a kilobyte.

It is published on change and from time to time, and kept by a storage of Zenoh's, so that it can be asked for while the
vehicle is parked. What came over a network is read with `read`, which bounds it.
"""

from __future__ import annotations

from typing import Final, Literal

import msgpack
from pydantic import Field, ValidationError

from coec.errors import DecodeError
from coec.schemas.base import Message
from coec.schemas.keys import LAST, VERSION_CHUNK
from coec.schemas.replies import Alarms, Count, HealthState, Maybe6, Provenance, Reason, Status, Vector6

MAX_BYTES: Final = 16_384
"""Of a word; one with every reason that it may have takes a third."""

MAX_REASONS: Final = 8
MAX_TEXT: Final = 400
"""Characters of a reason's sentence in a word."""

MAX_NESTING: Final = 256
"""Entries of a list or a map in a word, for whoever unpacks one."""


class LastWord(Message):
    """What a pair said last. Times are those of the vehicle's clocks."""

    vehicle: str
    pair: str
    said_ns: Count = Field(description="wall clock of the vehicle when it said this, ns since 1970")
    period_s: float = Field(gt=0, description="it is said again after so long, also when nothing has changed")
    service: Literal["starting", "running", "stopping", "failing"] = Field(
        description="`stopping`: the vehicle took its leave, and nothing more is to be expected of it"
    )
    version: str = Field(max_length=64)
    config_hash: str = Field(max_length=64)
    state: HealthState
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    reasons: tuple[Reason, ...] = Field(max_length=MAX_REASONS, description="the first of them")
    since_ns: int = Field(description="wall clock when the state began, ns since 1970")
    age_s: float | None = Field(description="of the last evaluated data when this was said; null before the first")
    drift: Maybe6 | None = Field(description="of what is served from commissioned (deg, m); null before commissioning")
    drift_sigma: Maybe6 | None = Field(description="standard deviations of `drift` (deg, m)")
    provenance: Provenance | None = Field(description="of what is served; null while the pair is awaited")
    status: Status | None = Field(description="of the latest attempt; null while the pair is awaited")
    correction: Vector6 | None = Field(description="of what was solved last, from nominal (deg, m)")
    sigma: Maybe6 | None = Field(description="standard deviations of `correction` (deg, m)")
    held: bool = Field(description="frozen by `command/hold`")
    windows: Count = Field(description="recorded since the start")
    alarms: Alarms | None = Field(default=None, description="how often it was accused; null while the pair is awaited")
    event: str | None = Field(max_length=128, description="id of the newest red event that is kept; null: none")


def read(key: str, payload: bytes) -> LastWord:
    """The word that came under a key.

    Raises:
        DecodeError: `word_too_large`, `word_malformed`, or `word_of_another`: it speaks for a vehicle or a pair that
            its key does not name.
    """
    if len(payload) > MAX_BYTES:
        raise DecodeError("word_too_large", f"a last word of more than {MAX_BYTES} bytes")
    try:
        document = msgpack.unpackb(
            payload, max_map_len=MAX_NESTING, max_array_len=MAX_NESTING, max_str_len=MAX_BYTES, max_bin_len=0
        )
        word = LastWord.model_validate(document)
    except (ValueError, RecursionError, msgpack.UnpackException, ValidationError) as error:
        raise DecodeError("word_malformed", "no last word in msgpack") from error
    if not key.endswith(f"/{VERSION_CHUNK}/{word.vehicle}/{LAST}/{word.pair}"):
        raise DecodeError("word_of_another", "a last word under the key of another")
    return word
