"""Troubles with the senders of a pair's streams: two senders at once, another sensor's frames, stamps by the wrong
clock, no sender at all."""

from __future__ import annotations

from collections.abc import Mapping

from coec.adapters.zenoh.ros_topics import RosTopicList, listed
from coec.calibration.types import Reason
from coec.config import PairConfig
from coec.runtime.ingest.decoder import StreamCounts
from coec.runtime.ingest.inbox import Arrivals

SILENT_S = 5.0
"""After this time without a sample, s, a stream whose topic nobody publishes is reported as missing."""


def stream_problems(streams: Mapping[str, StreamCounts], pair: PairConfig, topics: RosTopicList) -> tuple[Reason, ...]:
    """Troubles of the streams, for `health`."""
    reasons = []
    for name, stream in pair.streams.items():
        counts = streams.get(name)
        if counts is None:
            continue
        if counts.taking_turns:
            known = topics.nodes_of(counts.taking_turns)
            who = f": {listed(known)}" if known else ""
            # Senders without names are told apart by what they send, which does not count them.
            several = f"{len(counts.taking_turns)} publishers" if known else "Several programs"
            text = f"{several} send on {stream.place} at the same time{who}."
            reasons.append(Reason("two_senders", f"{text} Their frames are refused until only one sends."))
        if counts.foreign:
            text = f"On {stream.place} come frames with another frame id or image size beside those of the sensor"
            reasons.append(Reason("foreign_frames", f"{text}; they are refused."))
        if counts.stamped_by_sender:
            text = f"Messages on {stream.place} have no stamp: each has the stamp from the sender's clock."
            reasons.append(Reason("sender_clock", text))
    return tuple(reasons)


def missed_of(arrivals: Mapping[str, Arrivals], pair: PairConfig, topics: RosTopicList) -> tuple[str, ...]:
    """Sentences about the streams that nobody publishes, for `needs` of `health`."""
    sentences = []
    for name, stream in pair.streams.items():
        age_s = arrivals[name].age_s
        if stream.topic is not None and (age_s is None or age_s > SILENT_S):
            absent = topics.absent(stream.topic, stream.types)
            sentences += [f"{name}: {absent}"] if absent else []
    return tuple(sentences)
