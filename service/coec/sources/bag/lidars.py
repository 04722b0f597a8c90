"""Two LiDARs in a bag."""

from __future__ import annotations

import numpy as np

from coec.adapters.ros.transforms import bare
from coec.calibration.lidar_to_lidar.types import LidarRig
from coec.calibration.types import EgoMotion, LidarFrame
from coec.errors import DecodeError, SourceError
from coec.sources.bag.cloud_reading import CloudDecoder
from coec.sources.bag.index import CLOUD_TYPES, VELOCITY_TYPES, MessageLocation, build_index
from coec.sources.bag.storage import BagStorage, open_storage
from coec.sources.lidars import FrameStream, LidarRecording
from coec.sources.spec import SourceSpec

AS_THEY_ARE = CloudDecoder()


def lidars_of_bag(spec: SourceSpec, a: str, b: str) -> LidarRecording:
    """Opens `BAG[?odometry=/TOPIC]`. `a` and `b` are topics of clouds; the poses come from `/tf_static`.

    Raises:
        UsageError: an unknown query key.
        SourceError: no bag, no such topic, a damaged message, or no transform between the two LiDARs.
    """
    query = spec.only("odometry")
    storage = open_storage(spec.path)
    index = build_index(storage, AS_THEY_ARE)
    places = {topic: index.streams[index.topic(CLOUD_TYPES, topic, "points")].ordered() for topic in (a, b)}
    first = {topic: _load(storage, places[topic][0]) for topic in (a, b)}
    odometry = index.optional_topic(VELOCITY_TYPES, query.get("odometry"), "odometry")
    motions = index.streams[odometry].ordered() if odometry is not None else []
    frame_a, frame_b = (bare(first[topic].frame_id) for topic in (a, b))
    T_a_b = index.transform(frame_a, frame_b)
    if T_a_b is None:
        raise SourceError(f"{spec.path}: /tf_static does not connect {frame_a!r} and {frame_b!r}")
    T_a_ego = index.transform(frame_a, _load(storage, motions[0]).frame_id) if motions else None
    if T_a_ego is None:
        T_a_ego, motions = np.eye(4), []  # motion is of no use without its pose against the LiDARs

    def frames(of: list[MessageLocation]) -> FrameStream:
        return FrameStream(tuple(place.stamp_ns for place in of), lambda number: _load(storage, of[number]))

    return LidarRecording(
        spec.path.name, LidarRig(a, b, T_a_b, T_a_ego), frames(places[a]), frames(places[b]), frames(motions)
    )


def _load(storage: BagStorage, place: MessageLocation) -> LidarFrame | EgoMotion:
    with storage.open() as reader:
        data = reader.read(place.at)
    try:
        frame = AS_THEY_ARE.decode(place.type_name, data)
    except DecodeError as error:
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns: {error}") from error
    if not isinstance(frame, LidarFrame | EgoMotion):
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns is neither a cloud nor motion")
    return frame
