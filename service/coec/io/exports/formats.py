"""Writes an extrinsic into files of other programs: one module per format, and the names of all formats.

In a file that can hold several transforms, only this one is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from coec.io.exports import autoware, json_files, kalibr, kitti_text, opencv, tf, urdf
from coec.io.exports.exported_extrinsic import ExportedExtrinsic

JSON, TEXT, XML, YAML = "application/json", "text/plain", "application/xml", "application/yaml"


class Format(NamedTuple):
    """How a file is written.

    Attributes:
        text: returns the new content of the file, given its present content (None: there is no file yet). Raises
            `OutputError` if that is not possible.
        encoding: of the text, as Zenoh names encodings.
    """

    text: Callable[[ExportedExtrinsic, str | None], str]
    encoding: str


FORMATS: Final[Mapping[str, Format]] = MappingProxyType(
    {
        "tf": Format(tf.text, TEXT),
        "urdf": Format(urdf.text, XML),
        "autoware": Format(autoware.text, YAML),
        "kalibr": Format(kalibr.text, YAML),
        "kitti": Format(kitti_text.raw_text, TEXT),
        "kitti360": Format(kitti_text.kitti360_text, TEXT),
        "nuscenes": Format(json_files.nuscenes_text, JSON),
        "openlabel": Format(json_files.openlabel_text, JSON),
        "colmap": Format(json_files.colmap_text, JSON),
        "opencv": Format(opencv.text, YAML),
        "json": Format(json_files.plain_text, JSON),
    }
)
"""Formats by the names that a user writes."""
