"""The heartbeat of a pair: what a fleet centre needs to know about it, in a kilobyte.

The service publishes it on change and periodically. A Zenoh storage keeps it, so that it can be queried while the
vehicle is parked. `decode_heartbeat` decodes a word that came over a network, within bounds.
"""

from typing import Final, Literal

import msgpack
from pydantic import Field, ValidationError

from coec.errors import DecodeError
from coec.schemas.keys import LAST, VERSION_CHUNK
from coec.schemas.message import Message, Text
from coec.schemas.replies import Alarms, Count, HealthState, Maybe6, Provenance, Reason, Status, Vector6

MAX_HEARTBEAT_BYTES: Final = 16_384
"""Largest heartbeat; one with every reason that it may have takes a third of this."""

MAX_REASONS: Final = 8
MAX_TEXT: Final = 400
"""Most characters of a reason's sentence in a heartbeat."""

MAX_NESTING: Final = 256
"""Most entries of a list or a map in a heartbeat, when it is unpacked."""


class LastWord(Message):
    """The heartbeat of a pair. Times are from the vehicle's clocks."""

    vehicle: Text
    pair: Text
    said_ns: Count = Field(description="wall clock of the vehicle at this heartbeat, ns since 1970")
    period_s: float = Field(gt=0, description="repetition period, even if nothing has changed, s")
    service: Literal["starting", "running", "stopping", "failing"] = Field(
        description="`stopping`: the service ends, and no further heartbeat follows"
    )
    version: Text = Field(max_length=64)
    config_hash: Text = Field(max_length=64)
    state: HealthState
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    reasons: tuple[Reason, ...] = Field(max_length=MAX_REASONS, description="the first reasons for the state")
    since_ns: int = Field(description="wall clock when the state began, ns since 1970")
    age_s: float | None = Field(
        description="age of the last evaluated data at this heartbeat; null before the first data"
    )
    drift: Maybe6 | None = Field(
        description="served extrinsic from the commissioned one (deg, m); null before commissioning"
    )
    drift_sigma: Maybe6 | None = Field(description="standard deviations of `drift` (deg, m)")
    provenance: Provenance | None = Field(
        description="where the served extrinsic comes from; null while the pair is incomplete"
    )
    status: Status | None = Field(description="status of the latest attempt; null while the pair is incomplete")
    correction: Vector6 | None = Field(description="latest result, from nominal (deg, m)")
    sigma: Maybe6 | None = Field(description="standard deviations of `correction` (deg, m)")
    held: bool = Field(description="frozen by `command/hold`")
    windows: Count = Field(description="windows recorded since the start")
    alarms: Alarms | None = Field(default=None, description="its alarms by outcome; null while the pair is incomplete")
    event: Text | None = Field(max_length=128, description="id of the newest stored incident; null: none")


def decode_heartbeat(key: str, payload: bytes) -> LastWord:
    """The heartbeat that was received under a key.

    Raises:
        DecodeError: `word_too_large`, `word_malformed`, or `word_of_another`: the word names another vehicle or pair
            than its key.
    """
    if len(payload) > MAX_HEARTBEAT_BYTES:
        raise DecodeError("word_too_large", f"a heartbeat of more than {MAX_HEARTBEAT_BYTES} bytes")
    try:
        document = msgpack.unpackb(
            payload, max_map_len=MAX_NESTING, max_array_len=MAX_NESTING, max_str_len=MAX_HEARTBEAT_BYTES, max_bin_len=0
        )
        heartbeat = LastWord.model_validate(document)
    except (ValueError, RecursionError, msgpack.UnpackException, ValidationError) as error:
        raise DecodeError("word_malformed", "not a heartbeat in msgpack") from error
    if not key.endswith(f"/{VERSION_CHUNK}/{heartbeat.vehicle}/{LAST}/{heartbeat.pair}"):
        raise DecodeError("word_of_another", "a heartbeat under the key of another pair")
    return heartbeat
