"""A recording read by other people's programs: whatever is on any channel has to open in each of them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, Qos, QosDurability


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
