"""What there is to say of a pair's streams as their senders are: who sends, by which clock, and who does not."""

from __future__ import annotations

from collections.abc import Mapping

from coec.adapters.zenoh.ros_topics import Topics, listed
from coec.calibration.types import Reason
from coec.config import PairConfig
from coec.runtime.ingest.decoder import StreamCounts
from coec.runtime.ingest.inbox import Arrivals

SILENT_S = 5.0
"""Without a sample for so long, a stream whose topic nobody publishes is missed."""


def troubles_of(streams: Mapping[str, StreamCounts], pair: PairConfig, topics: Topics) -> tuple[Reason, ...]:
    """What ails the streams, for `health`."""
    found = []
    for name, stream in pair.streams.items():
        counts = streams.get(name)
        if counts is None:
            continue
        if counts.taking_turns:
            known = topics.nodes_of(counts.taking_turns)
            who = f": {listed(known)}" if known else ""
            text = f"{len(counts.taking_turns)} publishers send on {stream.place} at a time{who}."
            found.append(Reason("two_senders", f"{text} Their frames are taken as one sensor's."))
        if counts.stamped_by_sender:
            text = f"Messages on {stream.place} have no stamp: each has the stamp from the sender's clock."
            found.append(Reason("sender_clock", text))
    return tuple(found)


def missed_of(arrivals: Mapping[str, Arrivals], pair: PairConfig, topics: Topics) -> tuple[str, ...]:
    """Sentences on the streams that nobody publishes, for what is needed."""
    found = []
    for name, stream in pair.streams.items():
        age_s = arrivals[name].age_s
        if stream.topic is not None and (age_s is None or age_s > SILENT_S):
            absent = topics.absent(stream.topic, stream.types)
            found += [f"{name}: {absent}"] if absent else []
    return tuple(found)
