"""Tables of points in files of other programs: `.pcd` (v0.7, Point Cloud Library) and `.ply` (Turk 1994), in ascii and
binary, and `.las` (ASPRS LAS 1.4 R15; versions 1.0 to 1.4, point formats 0 to 10), with bounds on every size; `pypcd4`
allocates what a header claims.
"""

import itertools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.errors import SourceError

Table = NDArray[np.void]
"""(N,) points with named fields, as they are packed in the file. Not filtered."""

MAX_POINTS = 4_000_000
"""Most points of a sweep (a 128-beam LiDAR gives 0.3 million)."""

MAX_TABLE_BYTES = 128 * 2**20
"""Most bytes of all rows as they are packed: 32 for each of `MAX_POINTS`. Together with the file and the columns made
of the rows, a hostile header can so make coec allocate some 400 MB."""

MAX_UNPACKED_BYTES = 20 * 2**20
"""The same for compressed points. Unpacking more in plain Python would take too long; a sweep of 0.3 million points
with 10 columns has 12 MB."""

MAX_FIELDS = 256
"""Most fields of a point; drivers give about ten."""

MAX_LINE_BYTES = 65_536
"""Longest row in ascii, bytes."""

ASCII_BLOCK_BYTES = 2**20
"""Rows in ascii are parsed in blocks of this size, because as Python objects they take thirty times as much memory."""

MAX_HEADER_BYTES = 65_536
"""Longest header; PCL's headers have some 300 bytes."""


class TableError(ValueError):
    """What is wrong, with the line or byte where."""


@dataclass(frozen=True, slots=True)
class _Header:
    point: np.dtype[np.void]
    points: int
    encoding: str
    body: int
    body_line: int


def parse_pcd(data: bytes) -> Table:
    """The points of a PCD file.

    Raises:
        TableError: the file is not PCD, is truncated or contradicts itself; the message begins with the line or byte.
    """
    header = _pcd_header(_header_lines(data, "DATA", "PCD"))
    return _decompressed_table(data, header) if header.encoding == "binary_compressed" else _table(data, header)


def viewpoint_of(data: bytes) -> str:
    """The VIEWPOINT of a PCD file, as it stands there; empty if it is the identity, or if there is none."""
    try:
        values, _, _ = _header_lines(data, "DATA", "PCD")
        numbers = [float(text) for text in values.get("VIEWPOINT", ())]
    except ValueError:
        return ""
    return " ".join(values["VIEWPOINT"]) if numbers and numbers[:3] + numbers[4:] != [0.0] * 6 else ""


def _table(data: bytes, header: _Header) -> Table:
    """The points that are stored one after the other, as text or as bytes."""
    if header.encoding == "ascii":
        return _ascii_table(data, header)
    need = header.points * header.point.itemsize
    have = len(data) - header.body
    if have < need:
        raise TableError(f"byte {len(data)}: the file ends after {have} of {need} bytes of points")
    return np.frombuffer(data, header.point, header.points, header.body)


_HeaderLines = tuple[dict[str, list[str]], int, int]
"""The words of each line of a header by its first word, the place of the byte behind it, and the number of its last
line."""


def _header_lines(data: bytes, last: str, form: str) -> _HeaderLines:
    values: dict[str, list[str]] = {}
    start = line_number = 0
    while last not in values:
        end = data.find(b"\n", start, MAX_HEADER_BYTES)
        line_number += 1
        if end < 0:
            raise TableError(f"line {line_number}: the header ends without a {last} line")
        try:
            tokens = data[start:end].decode("ascii").split()
        except UnicodeDecodeError as error:
            raise TableError(f"line {line_number}: not a {form} header") from error
        if tokens and not tokens[0].startswith("#"):
            values[tokens[0]] = tokens[1:]
        start = end + 1
    return values, start, line_number


def _pcd_header(lines: _HeaderLines) -> _Header:
    values, start, line_number = lines

    def integers(key: str, count: int | None = None) -> list[int]:
        try:
            numbers = [int(value) for value in values[key]]
        except (KeyError, ValueError) as error:
            raise TableError(f"line {line_number}: the header has no valid {key}") from error
        if (count is not None and len(numbers) != count) or any(not 0 <= number < 2**63 for number in numbers):
            raise TableError(f"line {line_number}: the header has no valid {key}")
        return numbers

    names = values.get("FIELDS", [])
    sizes, types = integers("SIZE", len(names)), values.get("TYPE", [])
    counts = integers("COUNT", len(names)) if "COUNT" in values else [1] * len(names)
    width, height = integers("WIDTH", 1)[0], integers("HEIGHT", 1)[0]
    points = integers("POINTS", 1)[0] if "POINTS" in values else width * height
    if points != width * height or points > MAX_POINTS:
        raise TableError(f"line {line_number}: {points} POINTS do not agree with {width} x {height}, or are too many")
    if len(names) > MAX_FIELDS:
        raise TableError(f"line {line_number}: {len(names)} FIELDS; more than {MAX_FIELDS} do not come from a LiDAR")
    encoding = (values["DATA"] or [""])[0]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise TableError(f"line {line_number}: DATA must be ascii, binary or binary_compressed")
    point = _point_type(names, sizes, types, counts, line_number)
    return _bounded_header(_Header(point, points, encoding, start, line_number))


def _bounded_header(header: _Header) -> _Header:
    most = MAX_UNPACKED_BYTES if header.encoding == "binary_compressed" else MAX_TABLE_BYTES
    if header.points > MAX_POINTS or header.points * header.point.itemsize > most:
        raise TableError(
            f"line {header.body_line}: {header.points} points of {header.point.itemsize} bytes are more than the "
            f"{MAX_POINTS} points or {most} bytes that are read as {header.encoding}"
        )
    return header


def _point_type(
    names: list[str], sizes: list[int], types: list[str], counts: list[int], line: int
) -> np.dtype[np.void]:
    """The packed row of one point. Padding fields (`_`) and repeated names get a name of their own. Fields with COUNT
    0, which PCL's older writers leave where a driver's struct needs no padding, take no bytes."""
    if len(types) != len(names) or any(repeats > 4096 for repeats in counts):
        raise TableError(f"line {line}: FIELDS, SIZE, TYPE and COUNT do not agree")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    free = (f"_{number}" for number in itertools.count() if f"_{number}" not in names)
    for place, (name, size, kind, repeats) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if (kind, size) not in {("F", 4), ("F", 8), *((k, s) for k in "IU" for s in (1, 2, 4, 8))}:
            raise TableError(f"line {line}: field {name} has unknown type {kind}{size}")
        if repeats == 0:
            continue
        unique = name if name != "_" and name not in names[:place] else next(free)
        fields.append((unique, f"<{kind.lower()}{size}", (repeats,) if repeats > 1 else ()))
    missing = [axis for axis in "xyz" if axis not in names or counts[names.index(axis)] != 1]
    if missing:
        raise TableError(f"line {line}: FIELDS lacks {' '.join(missing)}")
    return np.dtype(fields)


def _ascii_table(data: bytes, header: _Header) -> Table:
    """The table from rows of numbers, block by block. NumPy reads a block at once; only if that fails are its lines
    checked one by one."""
    table = np.zeros(header.points, header.point)
    begin = 0
    for lines in _blocks(data, header):
        first_line = header.body_line + 1 + begin
        table[begin : begin + len(lines)] = _ascii_rows(lines, header.point, first_line)
        begin += len(lines)
    if begin < header.points:
        raise TableError(f"line {header.body_line + begin}: the file ends after {begin} of {header.points} points")
    return table


def _blocks(data: bytes, header: _Header) -> Iterator[list[str]]:
    """The lines of the points, block by block; empty lines at the end of the file are left out."""
    stream = BytesIO(data)
    stream.seek(header.body)
    lines: list[str] = []
    held = 0
    left = header.points
    while left and (line := stream.readline(MAX_LINE_BYTES + 1)):
        if len(line) > MAX_LINE_BYTES:
            raise TableError(f"line {header.body_line + 1 + header.points - left}: longer than {MAX_LINE_BYTES} bytes")
        lines.append(line.decode("ascii", errors="replace"))
        held += len(line)
        left -= 1
        if held >= ASCII_BLOCK_BYTES:
            yield lines
            lines, held = [], 0
    while lines and not lines[-1].strip():
        lines.pop()
    yield lines


def _ascii_rows(lines: list[str], point: np.dtype[np.void], first_line: int) -> Table:
    width = sum(int(np.prod(point[name].shape)) for name in point.names or ())
    try:
        values = np.array(" ".join(lines).split(), dtype=np.float64)
    except ValueError:
        values = np.empty(0)
    if values.size != len(lines) * width:
        for number, line in enumerate(lines, start=first_line):
            _check_row(line.split(), width, number)
    rows = values.reshape(len(lines), width)
    table = np.zeros(len(lines), point)
    column = 0
    for name in point.names or ():
        shape = point[name].shape
        span = int(np.prod(shape))
        block = rows[:, column : column + span].reshape(len(lines), *shape)
        if point[name].base.kind in "iu":
            block = _bounded(block, point[name].base, first_line)
        with np.errstate(over="ignore"):
            table[name] = block
        column += span
    return table


def _check_row(tokens: list[str], width: int, number: int) -> None:
    if len(tokens) != width:
        raise TableError(f"line {number}: expected {width} numbers, found {len(tokens)}")
    for token in tokens:
        try:
            float(token)
        except ValueError as error:
            raise TableError(f"line {number}: not a number") from error


def _bounded(values: NDArray[np.float64], dtype: np.dtype[np.generic], first_line: int) -> NDArray[np.float64]:
    """The values, checked to be in the range of their integer type, because a cast of others would be undefined."""
    limits = np.iinfo(dtype.type)  # type: ignore[type-var]
    # The largest 64-bit integer is not a double, and rounds to one that is out of range.
    fits = (values >= limits.min) & (values <= limits.max) & (values < float(limits.max) + 1.0)
    bad = ~fits
    if bad.any():
        raise TableError(f"line {first_line + int(np.argwhere(bad)[0, 0])}: a value does not fit its type {dtype}")
    return values


def _decompressed_table(data: bytes, header: _Header) -> Table:
    """The table from LZF-compressed columns, which PCL stores one after another, not by row."""
    start = header.body + 8
    if len(data) < start:
        raise TableError(f"byte {len(data)}: the file ends before the size of its compressed points")
    packed, unpacked = np.frombuffer(data, "<u4", 2, header.body).tolist()
    if unpacked != header.points * header.point.itemsize:
        raise TableError(f"byte {header.body}: {unpacked} bytes are promised, the header needs {header.points} points")
    if packed > unpacked + unpacked // 25 + 64:  # liblzf's own worst case is 104 %
        raise TableError(
            f"byte {header.body}: {packed} compressed bytes for {unpacked}: no compression makes them more"
        )
    if len(data) < start + packed:
        raise TableError(f"byte {len(data)}: the file ends after {len(data) - start} of {packed} compressed bytes")
    columns = _lzf_decompress(data, start, start + packed, unpacked)
    table = np.zeros(header.points, header.point)
    offset = 0
    for name in header.point.names or ():
        field = header.point[name]
        count = header.points * int(np.prod(field.shape))
        table[name] = np.frombuffer(columns, field.base, count, offset).reshape(header.points, *field.shape)
        offset += header.points * field.itemsize
    return table


def _lzf_decompress(data: bytes, start: int, end: int, size: int) -> bytes:
    """LZF (Marc Lehmann's liblzf): literal runs of up to 32 bytes, back references of 3 to 264 bytes."""
    out = bytearray()
    at = start
    while at < end:
        control = data[at]
        at += 1
        if control < 32:
            run = control + 1
            if at + run > end:
                raise TableError(f"byte {at}: damaged compressed points (a run passes the end)")
            out += data[at : at + run]
            at += run
        else:
            length = control >> 5
            if at + (2 if length == 7 else 1) > end:
                raise TableError(f"byte {at}: damaged compressed points (a reference is cut)")
            if length == 7:
                length += data[at]
                at += 1
            distance = ((control & 31) << 8 | data[at]) + 1
            at += 1
            length += 2
            begin = len(out) - distance
            if begin < 0:
                raise TableError(f"byte {at}: damaged compressed points (a reference before the start)")
            if distance >= length:
                out += out[begin : begin + length]
            else:  # the reference overlaps what it writes: the last `distance` bytes repeat
                out += (bytes(out[begin:]) * (length // distance + 1))[:length]
        if len(out) > size:
            raise TableError(f"byte {at}: damaged compressed points (more than the {size} bytes promised)")
    if len(out) != size:
        raise TableError(f"byte {end}: damaged compressed points ({len(out)} of {size} bytes)")
    return bytes(out)


_PLY_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}

_PLY_FORMATS: Final = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


def parse_ply(data: bytes) -> Table:
    """The vertices of a PLY file (Turk 1994), which have to be its first element; what follows them is not read.

    Raises:
        TableError: the file is not PLY, is truncated, or its vertices are not its first element or hold lists.
    """
    if not data.startswith(b"ply"):
        raise TableError("line 1: not a PLY header")
    _, body, last_line = _header_lines(data, "end_header", "PLY")
    lines = [line.split() for line in data[:body].decode("ascii").splitlines()]
    encoding = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    elements = [number for number, line in enumerate(lines) if line[:1] == ["element"]]
    if encoding not in _PLY_FORMATS or not elements:
        raise TableError(f"line {last_line}: the header has no valid format or no element")
    first, end = elements[0], (*elements, len(lines))[1]
    if len(lines[first]) != 3 or lines[first][1] != "vertex" or not lines[first][2].isdecimal():
        raise TableError(f"line {first + 1}: the first element is not `vertex` with its number")
    properties = [line for line in lines[first:end] if line[:1] == ["property"]]
    if len(properties) > MAX_FIELDS or any(len(line) != 3 or line[1] not in _PLY_TYPES for line in properties):
        raise TableError(f"line {first + 1}: a property of the vertices is a list, or of an unknown type")
    order = _PLY_FORMATS[encoding]
    names = [name for _, _, name in properties]
    fields = [
        (name if name not in names[:place] else f"_{place} {name}", order + _PLY_TYPES[kind])
        for place, (_, kind, name) in enumerate(properties)
    ]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise TableError(f"line {first + 1}: the vertices have no {' '.join(missing)}")
    points = int(lines[first][2][:20])
    form = "ascii" if encoding == "ascii" else "binary"
    return _table(data, _bounded_header(_Header(np.dtype(fields), points, form, body, last_line)))


# --- LAS --------------------------------------------------------------------------------------------------------------

_LAS_HEADER: Final = struct.Struct("<4s20xBB68xHII BHI 20x 6d")
"""Signature, version, size of the header, where points begin, number of other records, point format, bytes and number
of the points; scales and offsets of x y z."""

_LAS_1_4_HEADER, _LAS_COUNT_AT = 375, 247
"""Bytes of the header of version 1.4, and where the number of points stands in it."""

_LAS_TIME_AT: Final = {1: 20, 3: 20, 4: 20, 5: 20, **dict.fromkeys(range(6, 11), 22)}
"""Where the time of a point stands, by the point format."""

_LAS_LEAST_BYTES: Final = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Bytes of a point by its format; files may add further ones."""

_LASZIP: Final = 0x80
"""Bit of the point format by which LASzip marks its files."""


def columns_of_las(data: bytes, where: Path) -> dict[str, NDArray[Any]]:
    """x, y, z (N,) float64 metres, intensity, and timestamp, seconds of GPS, if it is given.

    Raises:
        SourceError: the file is not LAS, compressed, cut off, or has more points than `MAX_POINTS`.
    """
    if len(data) < _LAS_HEADER.size or data[:4] != b"LASF":
        raise SourceError(f"{where}, byte 0: no header of a LAS file")
    _, major, minor, header_bytes, begin, _, form, step, count, *scaling = _LAS_HEADER.unpack_from(data)
    if form & _LASZIP:
        raise SourceError(
            f"{where}, byte 104: it is LAZ: unpack it with `laszip -i IN.laz -o OUT.las`, or `pdal translate`"
        )
    if (major, minor) >= (1, 4) and header_bytes >= _LAS_1_4_HEADER and len(data) >= _LAS_1_4_HEADER:
        (count,) = struct.unpack_from("<Q", data, _LAS_COUNT_AT)
    if major != 1 or form >= len(_LAS_LEAST_BYTES) or step < _LAS_LEAST_BYTES[form]:
        raise SourceError(f"{where}, byte 104: version {major}.{minor} with points of type {form} is not read")
    if not 0 < count <= MAX_POINTS:
        raise SourceError(f"{where}, byte 107: it has {count} points; a sweep has up to {MAX_POINTS}")
    if begin < _LAS_HEADER.size or count * step > len(data) - begin:
        raise SourceError(f"{where}, byte {begin}: {count} points of {step} bytes are cut off after {len(data)} bytes")
    layout = {"X": ("<i4", 0), "Y": ("<i4", 4), "Z": ("<i4", 8), "intensity": ("<u2", 12)}
    if form in _LAS_TIME_AT:
        layout["timestamp"] = ("<f8", _LAS_TIME_AT[form])
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
