"""Where the samples of a stream come from and what comes with them: on native keys, from rmw_zenoh or from a bridge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from coec.adapters.ros.wire import rmw_zenoh, ros2dds
from coec.config import Config, StreamConfig
from coec.errors import UsageError

CDR = "application/cdr"

NO_TYPE = "?"
"""Stands for the type of a message if its key holds none."""


@dataclass(frozen=True, slots=True)
class InputSample:
    """A message as it was received.

    Attributes:
        encoding: as the sender gives it, for example `application/cdr;TYPE`.
        attachment: bytes beside the message in which the sender should give a sequence number and its id; empty if they
            cannot be that. None: messages of this stream have no attachment.
        origin: id of the session that stamped the message for Zenoh: the sender's, or that of the first router on its
            way. Empty if nobody did.
    """

    payload: bytes
    encoding: str
    attachment: bytes | None = None
    origin: bytes = b""


@dataclass(frozen=True, slots=True)
class StreamInput:
    """How to listen to one stream: key expressions to subscribe to, and a function that reads the samples.

    Attributes:
        token: liveliness token that shows the subscription to others; None if none is needed.
    """

    expressions: tuple[str, ...]
    read: Callable[[zenoh.Sample], InputSample]
    token: str | None = None


def input_of(stream: StreamConfig, config: Config) -> StreamInput:
    """The input of a stream of this configuration."""
    if stream.key is not None:
        return on_key(stream.key)
    if config.middleware == "ros2dds":
        return on_key(ros2dds.topic_key(config.ros.namespace, stream.place))
    return StreamInput(rmw_zenoh.topic_expressions(config.ros.domain, stream.place), _typed_by_key)


def on_key(key: str) -> StreamInput:
    """The input for everything that is put on one key."""
    return StreamInput((key,), _as_it_is)


def _as_it_is(sample: zenoh.Sample) -> InputSample:
    stamp = sample.timestamp
    origin = b"" if stamp is None else str(stamp.get_id()).encode()
    return InputSample(sample.payload.to_bytes(), str(sample.encoding), origin=origin)


def _typed_by_key(sample: zenoh.Sample) -> InputSample:
    """Reads a sample from rmw_zenoh, whose key holds the type; its encoding says nothing."""
    try:
        type_name = rmw_zenoh.TopicKey.parse(str(sample.key_expr)).type_name
    except UsageError:
        type_name = NO_TYPE
    received = sample.attachment
    readable = received is not None and len(received) <= rmw_zenoh.MAX_ATTACHMENT
    attachment = received.to_bytes() if received is not None and readable else b""
    return InputSample(sample.payload.to_bytes(), f"{CDR};{type_name}", attachment)
