"""The grammar of a SOURCE argument: `[layout:]path[?key=value&…]`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qsl

from coec.adapters.files.home import expand_home
from coec.errors import UsageError

FORMS = """accepted forms of a source:
  FILE.mcap                                     a recorded window
  BAG?camera=/TOPIC&points=/TOPIC&...           any ROS 2 bag: FILE.mcap, FILE.db3 or rosbag2's folder (topics are found
                                                by type where they are unique; lidar_frame=NAME for clouds in another,
                                                moving=PARENT,CHILD for motion on /tf, time=FIELD,UNIT[,BASE],
                                                lidar_source=N for one LiDAR of a cloud of several)
  kitti360:ROOT?drive=...&camera=image_00       KITTI-360 in its official folders
  kitti-raw:ROOT?drive=...&camera=image_02      KITTI raw in its official folders, or one drive with its calib_*.txt
  FOLDER or dataset.yaml                        images and clouds listed in a manifest
  sim:seed=1&seconds=60&camera=fisheye700&...   a seeded drive through a town that does not exist (extra `sim`)
  sim:rig=four-fisheyes&pair=front-roof&...     one pair of a simulated rig"""

LAYOUTS = ("kitti360", "kitti-raw", "sim")


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """A parsed SOURCE: its layout (None for a plain path), its path and its query."""

    text: str
    layout: str | None
    path: Path
    query: dict[str, str] = field(default_factory=dict)

    def only(self, *keys: str) -> dict[str, str]:
        """The query, checked to hold no other keys than these.

        Raises:
            UsageError: names the unknown keys and the known ones.
        """
        unknown = sorted(set(self.query) - set(keys))
        if unknown:
            known = f"known here: {', '.join(keys)}" if keys else "this kind of source takes none"
            raise UsageError(f"unknown query key {', '.join(unknown)} in {self.text}; {known}", FORMS)
        return self.query


def parse_spec(text: str) -> SourceSpec:
    """Splits a SOURCE argument.

    Raises:
        UsageError: an unknown layout, a malformed query or a missing path; lists the accepted forms.
    """
    prefix, colon, rest = text.partition(":")
    layout = prefix if colon and prefix in LAYOUTS else None
    if layout is None and colon and "/" not in prefix and "." not in prefix:
        raise UsageError(f"unknown source layout {prefix!r} in {text}", FORMS)
    # A simulated drive has no path, so the question mark may be left out.
    place = f"?{rest.removeprefix('?')}" if layout == "sim" else rest if layout else text
    location, _, query = place.partition("?")
    if not location and layout != "sim":
        raise UsageError(f"no path in source {text!r}", FORMS)
    return SourceSpec(text, layout, expand_home(location), _parse_query(query, text))


def is_bag(spec: SourceSpec) -> bool:
    """Whether the source is a ROS 2 bag or a recorded window, by the name of the file or the content of the folder."""
    by_name = spec.path.suffix in (".mcap", ".db3") or (spec.path / "metadata.yaml").is_file()
    return spec.layout is None and by_name


def is_rig(spec: SourceSpec) -> bool:
    """Whether the source is a whole simulated rig, not one pair of it."""
    return spec.layout == "sim" and "rig" in spec.query and "pair" not in spec.query


def _parse_query(query: str, text: str) -> dict[str, str]:
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise UsageError(f"malformed query in source {text}: {error}", FORMS) from error
    result: dict[str, str] = {}
    for key, value in pairs:
        if key in result:
            raise UsageError(f"query key {key} given twice in source {text}")
        if not value:
            raise UsageError(f"query key {key} has no value in source {text}")
        result[key] = value
    return result
