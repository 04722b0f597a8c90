"""Where the samples of a stream come from, and what is told beside them: by key, by rmw_zenoh or by its bridge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from coec.adapters.ros.wire import rmw_zenoh, ros2dds
from coec.config import Config, StreamConfig
from coec.errors import UsageError

CDR = "application/cdr"

NO_TYPE = "?"
"""In place of a type, where a key has none that can be one."""


@dataclass(frozen=True, slots=True)
class Sample:
    """A message as it came.

    Attributes:
        encoding: as the sender says it, `application/cdr;TYPE` for instance.
        attachment: bytes beside the message where its sender should say its number and who it is; empty where they
            cannot be such. None: nobody says that on this stream.
    """

    payload: bytes
    encoding: str
    attachment: bytes | None = None


@dataclass(frozen=True, slots=True)
class Input:
    """How to listen to one stream: key expressions to subscribe to, and how to read what comes."""

    expressions: tuple[str, ...]
    read: Callable[[zenoh.Sample], Sample]


def input_of(stream: StreamConfig, config: Config) -> Input:
    """That of a stream of this configuration."""
    if stream.key is not None:
        return on_key(stream.key)
    if config.middleware == "ros2dds":
        return on_key(ros2dds.topic_key(config.ros.namespace, stream.place))
    return Input(rmw_zenoh.topic_expressions(config.ros.domain, stream.place), _typed_by_key)


def on_key(key: str) -> Input:
    """That of whatever is put on one key."""
    return Input((key,), _as_it_is)


def _as_it_is(sample: zenoh.Sample) -> Sample:
    return Sample(sample.payload.to_bytes(), str(sample.encoding))


def _typed_by_key(sample: zenoh.Sample) -> Sample:
    """Of rmw_zenoh: the type stands in the key, and its encoding says nothing."""
    try:
        type_name = rmw_zenoh.TopicKey.parse(str(sample.key_expr)).type_name
    except UsageError:
        type_name = NO_TYPE
    told = sample.attachment
    readable = told is not None and len(told) <= rmw_zenoh.MAX_ATTACHMENT
    attachment = told.to_bytes() if told is not None and readable else b""
    return Sample(sample.payload.to_bytes(), f"{CDR};{type_name}", attachment)
