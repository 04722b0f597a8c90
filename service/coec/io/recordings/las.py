"""Points of LAS files (ASPRS LAS 1.4 R15; versions 1.0 to 1.4, point formats 0 to 10), with bounds on every size."""

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.errors import SourceError

_HEADER: Final = struct.Struct("<4s20xBB68xHII BHI 20x 6d")
"""Signature, version, size of the header, where points begin, number of other records, point format, bytes and number
of the points; scales and offsets of x y z."""

_LATER_HEADER, _COUNT_AT = 375, 247
"""Bytes of the header of version 1.4, and where the number of points stands in it."""

_TIME_AT: Final = {1: 20, 3: 20, 4: 20, 5: 20, **dict.fromkeys(range(6, 11), 22)}
"""Where the time of a point stands, by the point format."""

_LEAST_BYTES: Final = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Bytes of a point by its format; files may add further ones."""

_COMPRESSED: Final = 0x80
"""Bit of the point format by which LASzip marks its files."""


def columns_of_las(data: bytes, where: Path, most_points: int) -> dict[str, NDArray[Any]]:
    """x, y, z (N,) float64 metres, intensity, and timestamp, seconds of GPS, if it is given.

    Raises:
        SourceError: the file is not LAS, compressed, cut off, or has more points than `most_points`.
    """
    if len(data) < _HEADER.size or data[:4] != b"LASF":
        raise SourceError(f"{where}, byte 0: no header of a LAS file")
    _, major, minor, header_bytes, begin, _, form, step, count, *scaling = _HEADER.unpack_from(data)
    if form & _COMPRESSED:
        raise SourceError(
            f"{where}, byte 104: it is LAZ: unpack it with `laszip -i IN.laz -o OUT.las`, or `pdal translate`"
        )
    if (major, minor) >= (1, 4) and header_bytes >= _LATER_HEADER and len(data) >= _LATER_HEADER:
        (count,) = struct.unpack_from("<Q", data, _COUNT_AT)
    if major != 1 or form >= len(_LEAST_BYTES) or step < _LEAST_BYTES[form]:
        raise SourceError(f"{where}, byte 104: version {major}.{minor} with points of type {form} is not read")
    if not 0 < count <= most_points:
        raise SourceError(f"{where}, byte 107: it has {count} points; a sweep has up to {most_points}")
    if begin < _HEADER.size or count * step > len(data) - begin:
        raise SourceError(f"{where}, byte {begin}: {count} points of {step} bytes are cut off after {len(data)} bytes")
    layout = {"X": ("<i4", 0), "Y": ("<i4", 4), "Z": ("<i4", 8), "intensity": ("<u2", 12)}
    if form in _TIME_AT:
        layout["timestamp"] = ("<f8", _TIME_AT[form])
    names = list(layout)
    kinds, offsets = [layout[name][0] for name in names], [layout[name][1] for name in names]
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
    rows = np.frombuffer(data, dtype, count, begin)
    columns: dict[str, NDArray[Any]] = {
        axis: rows[axis.upper()] * scaling[place] + scaling[3 + place] for place, axis in enumerate("xyz")
    }
    columns["intensity"] = rows["intensity"]
    if "timestamp" in names and rows["timestamp"].any():
        columns["timestamp"] = rows["timestamp"]
    return columns
