"""The page on what recordings may hold, from the tables of the readers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import get_args

from coec.config import PacketMessage
from coec.io.recordings import bag_index
from coec.io.ros import (
    hesai_packets,
    messages,
    ouster_packets,
    packed_clouds,
    packet_streams,
    point_clouds,
    robosense_packets,
)
from coec.io.ros.message_decoding import DEEP_COLOURS, ENCODINGS, KNOWN, REFUSED, SEMIPLANAR
from coec.io.ros.translations import BY_SCHEMA
from generate.markdown import WRITTEN, code, table

PAGE = """\
# What is read

{written}
[Recordings](recordings.md#formats) describes how. Types of ROS 2 are read in CDR, those of ROS 1 in their own form,
schemas of Foxglove in protobuf and JSON. The service reads the types of ROS 2 that are marked as live.

## Messages

{messages}
## In messages

{parts}
## Not read, with what to do

{refused}"""

GIVES = {
    **dict.fromkeys((messages.COMPRESSED_IMAGE, messages.IMAGE), "images"),
    **dict.fromkeys(bag_index.VIDEO_TYPES, "video"),
    **dict.fromkeys(bag_index.POINT_TYPES, "clouds"),
    **dict.fromkeys(packed_clouds.TYPES, "clouds"),
    messages.VELODYNE_SCAN: "packets of a LiDAR",
    **dict.fromkeys(packet_streams.TYPES, "packets of a LiDAR"),
    **dict.fromkeys((*bag_index.VELOCITY_TYPES, *bag_index.ROTATION_TYPES), "motion"),
    messages.CAMERA_INFO: "intrinsics",
    messages.TF: "transforms; motion",
}
"""What each type gives."""


def formats_page() -> str:
    """All messages that are read, and what they may hold."""
    return PAGE.format(
        written=WRITTEN,
        messages=table(("type of ROS 2", "of ROS 1 and Foxglove", "gives", "live"), _messages()),
        parts=table(("what", "values"), _parts()),
        refused=table(
            ("type", "instead"), ((code(name), advice) for name, advice in REFUSED.items() if name not in GIVES)
        ),
    )


def _messages() -> Iterator[tuple[str, str, str, str]]:
    also: dict[str, list[str]] = {}
    for (encoding, schema), translation in BY_SCHEMA.items():
        names = also.setdefault(translation.type_name, [])
        if encoding != "json" and schema not in names:
            names.append(schema)
    live = {*KNOWN, *get_args(PacketMessage), messages.CAMERA_INFO, messages.TF}
    for name, gives in GIVES.items():
        yield code(name), _codes(sorted(also.get(name, ()))), gives, "yes" if name in live else ""


def _parts() -> Iterator[tuple[str, str]]:
    yield "encodings of raw images", _codes((*ENCODINGS, *SEMIPLANAR, *DEEP_COLOURS))
    yield "fields that are times of points, the first that there is", _codes(point_clouds.FIELDS)
    yield "fields that are reflectance, likewise", _codes(point_clouds.REFLECTANCE_FIELDS)
    yield "fields that are scan lines, likewise", _codes(point_clouds.RING_FIELDS)
    yield "fields that name one LiDAR of several", _codes(point_clouds.SOURCE_FIELDS)
    yield "formats of packed clouds", _codes(("draco", *packed_clouds.FORMATS))
    units: dict[float, list[str]] = {}
    for profile, packing in ouster_packets.PROFILES.items():
        units.setdefault(packing.range_m, []).append(profile)
    for range_m, profiles in units.items():
        yield f"profiles of an Ouster with ranges in {1e3 * range_m:g} mm", _codes(profiles)
    yield "models of Hesai", ", ".join(model.name for model in hesai_packets.MODELS)
    yield (
        "models of Hesai with a correction file only",
        f"{hesai_packets.PLATFORM_128} and others of its platform (OT128)",
    )
    yield "models of RoboSense", ", ".join(model.name for model in robosense_packets.MODELS)
    yield "models of Hesai that are refused by name", ", ".join(dict.fromkeys(hesai_packets.UNREAD.values()))


def _codes(names: Iterable[str]) -> str:
    return " ".join(map(code, names))
