"""All topics of a bag, with their messages as they were recorded."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from coec.adapters.ros.topics import TopicInfo, TopicMessage
from coec.errors import SourceError, UsageError
from coec.sources.bag.storage import BagStorage, open_storage
from coec.sources.spec import SourceSpec, is_bag


@dataclass(frozen=True, slots=True, order=True)
class _LoggedMessage:
    logged_ns: int
    at: tuple[int, ...]
    topic: str


@dataclass(frozen=True, slots=True, eq=False)
class BagTopics:
    """The topics of a bag that was read through once.

    Attributes:
        infos: the topics of CDR messages, in the order of their names.
    """

    name: str
    infos: dict[str, TopicInfo]
    _storage: BagStorage
    _places: tuple[_LoggedMessage, ...]

    def messages(self, topics: Collection[str]) -> Iterator[TopicMessage]:
        """The messages of these topics, in the order in which they were recorded, each loaded when it is its turn.

        Raises:
            SourceError: the file is no longer what it was.
        """
        with self._storage.open() as reader:
            for place in self._places:
                if place.topic in topics:
                    type_name = self.infos[place.topic].type_name
                    yield TopicMessage(place.logged_ns, place.topic, type_name, reader.read(place.at))


def open_topics(spec: SourceSpec) -> BagTopics:
    """Opens the topics of a bag or of a recorded window.

    Raises:
        UsageError: the source is no bag, or has a query, which cannot choose topics.
        SourceError: the bag is cut off or damaged, or a topic has messages of two types.
    """
    if not is_bag(spec):
        raise UsageError(f"{spec.text} is no bag")
    spec.only()
    storage = open_storage(spec.path)
    types: dict[str, str] = {}
    places: list[_LoggedMessage] = []
    for entry in storage.entries():
        if types.setdefault(entry.topic, entry.type_name) != entry.type_name:
            raise SourceError(f"{spec.path}: {entry.topic} has messages of several types")
        places.append(_LoggedMessage(entry.logged_ns, entry.place, entry.topic))
    places.sort()
    times_ns: defaultdict[str, list[int]] = defaultdict(list)
    for place in places:
        times_ns[place.topic].append(place.logged_ns)
    infos = {topic: _info(types[topic], times_ns[topic]) for topic in sorted(types)}
    return BagTopics(spec.path.name, infos, storage, tuple(places))


def _info(type_name: str, logged_ns: Sequence[int]) -> TopicInfo:
    """What is known of a topic, from the ascending times of its messages."""
    span_s = (logged_ns[-1] - logged_ns[0]) * 1e-9
    return TopicInfo(type_name, len(logged_ns), (len(logged_ns) - 1) / span_s if span_s > 0 else 0.0)
