"""Point clouds from files: `.bin`, `.npy`, `.npz`, `.pcd` (v0.7, Point Cloud Library) and `.ply`, the last two in
ascii and binary, with bounds on every size; `pypcd4` allocates what a header claims.

A `.bin` is a table of float32 that does not say how many belong to a point: KITTI has four (x y z intensity), nuScenes
five (and ring), others three or six. The number is recognised from the values. With a wrong number each column mixes
what belongs to several, so that intensities are negative and all columns are distributed alike. If two numbers fit, the
file is refused until `cloud_columns` says which is right. What stands in further columns is recognised, too: ring
numbers are whole and each has one elevation; any other column is left out.

Times of points are recognised as those of `PointCloud2` are, see `ros.point_clouds`. Rows with a non-finite coordinate
are dropped together with their intensity, ring and time.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import NO_SCAN_LINES, OriginCheck, from_origin, unordered
from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.config import PointTimeConfig
from coec.errors import DecodeError, SourceError
from coec.geometry.points import lengths
from coec.io.frame_validation import Refusal, finite_rows
from coec.io.recordings.las import columns_of_las
from coec.io.ros.point_clouds import FIELDS, offsets_s
from coec.io.user_files import read_bytes, read_npy, read_npz

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


# --- clouds from tables -----------------------------------------------------------------------------------------------

Columns = Mapping[str, NDArray[Any]]
"""`x`, `y` and `z`, and if the file has them `intensity`, `ring` and times, each (N,). Not filtered."""

XYZI: Final = ("x", "y", "z", "intensity")

UNUSED: Final = "_"
"""Name of a column that is left out."""

MAX_COLUMNS: Final = 64
"""Most columns of a table without names."""

_RINGS: Final = ("ring", "channel")
_WRITTEN_OFFSET: Final = "time_offset_s"
"""Seconds after the stamp, by coec's own name."""


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """How the cloud files of a recording are read, where they do not say it themselves.

    Attributes:
        columns: names of the columns of `.bin` and `.npy`; empty: they are recognised.
        point_time: how points are timed; None: it is recognised.
    """

    columns: tuple[str, ...] = ()
    point_time: PointTimeConfig | None = None


def load_cloud(stamp_ns: int, frame_id: str, path: Path, layout: CloudLayout = CloudLayout()) -> LidarFrame:
    """A sweep from a `.pcd`, `.ply`, `.las`, `.bin`, `.npy` or `.npz` file, by its suffix.

    `.npy` holds a table of floats (N, 3) or more, x y z [intensity ...], or rows with named fields. `.npz` holds `xyz`
    (N, 3) and may hold `intensity`, `ring` and `time_offset_s`, each (N,). Metres, seconds after `stamp_ns`.

    Raises:
        SourceError: unreadable, truncated, malformed, ambiguous or empty; names file, line or byte.
    """
    # A double that is too large for a float becomes infinite, and its point is dropped.
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            columns, recognised = _columns(path, layout)
            frame = _frame(stamp_ns, frame_id, path, columns, layout.point_time)
        except TableError as error:
            raise SourceError(f"{path}, {error}") from error
        except DecodeError as error:
            raise SourceError(f"{path}: {error}, of a dataset.yaml with `cloud_time:`") from error
    return replace(frame, recognitions=(*recognised, *frame.recognitions))


FARTHEST_MEDIAN_M = 400.0
"""Median range of a sweep above which its unit is wrong: LiDARs of vehicles reach 200 to 400 m. In millimetres, a room
of a metre has a thousand."""


def measured_from(
    cloud: LidarFrame,
    T_cloud_lidar: Matrix4,
    frame_id: str,
    where: Path,
    advice: Mapping[str, str],
    has_scan_lines: bool = False,
    checked: LidarFrame | None = None,
) -> LidarFrame:
    """A sweep in the LiDAR's own frame, see `from_origin`; without ring numbers that are no scan lines, unless
    a person says that they are (`has_scan_lines`). A sweep soon after one that was `checked` is as that one.

    Raises:
        SourceError: the points are in millimetres, or were not measured from the origin of that frame. The message of
            the latter ends with the entry of `advice` for the cause.
    """
    sweep = from_origin(cloud, T_cloud_lidar, frame_id)
    if checked is not None:
        return unordered(sweep) if NO_SCAN_LINES in checked.recognitions else sweep
    median_m = float(np.median(lengths(sweep.xyz_m))) if len(sweep.xyz_m) else 0.0
    if median_m > FARTHEST_MEDIAN_M:
        raise SourceError(
            f"{where}: half of the points are farther than {median_m:.0f} m: coordinates are in metres, "
            "from the LiDAR, so divide millimetres by 1000, and write points of a map in the frame of the LiDAR"
        )
    check = OriginCheck()
    contradiction = check.inspect(sweep)
    if contradiction is not None:
        raise SourceError(f"{where}: {contradiction.sentence} {advice[contradiction.cause]}")
    return sweep if has_scan_lines or check.has_scan_lines(sweep) else unordered(sweep)


def _frame(
    stamp_ns: int, frame_id: str, path: Path, columns: Columns, point_time: PointTimeConfig | None
) -> LidarFrame:
    if len(columns["x"]) > MAX_POINTS:
        raise SourceError(f"{path} has {len(columns['x'])} points; no sweep has more than {MAX_POINTS}")
    xyz_m = np.stack([np.asarray(columns[axis], dtype=np.float32) for axis in "xyz"], axis=1)
    time_offset_s, timed_by = _times(columns, finite_rows(xyz_m), stamp_ns, point_time)
    keep = np.isfinite(xyz_m).all(axis=1)
    if time_offset_s is not None:
        keep &= np.isfinite(time_offset_s)
    if not keep.any():
        raise SourceError(f"{path} holds no finite point ({len(xyz_m)} rows)")
    intensity, ring = columns.get("intensity"), next((columns[name] for name in _RINGS if name in columns), None)
    if ring is not None and (ring.dtype.kind not in "iu" or int(ring.max()) > 0xFFFF or int(ring.min()) < 0):
        ring = ring if _are_rings(ring, xyz_m) else None
    return LidarFrame(
        stamp_ns,
        frame_id,
        xyz_m[keep],
        intensity=None if intensity is None else intensity[keep].astype(np.float32),
        ring=None if ring is None else np.nan_to_num(ring[keep]).astype(np.uint16),
        time_offset_s=None if time_offset_s is None else time_offset_s[keep],
        timed_by=timed_by,
        not_finite=int((~keep).sum()),
    )


def _times(
    columns: Columns, keep: NDArray[np.bool_] | None, stamp_ns: int, point_time: PointTimeConfig | None
) -> tuple[NDArray[np.float32] | None, str]:
    """Seconds after the stamp (N,), and how they were read. Times of a clock that the stamp does not share are left
    out, because a file may be stamped by its number in a list.

    Raises:
        DecodeError: `cloud_time_ambiguous`.
    """
    if point_time is None and _WRITTEN_OFFSET in columns:
        return np.asarray(columns[_WRITTEN_OFFSET], dtype=np.float32), ""
    names = FIELDS if point_time is None else (point_time.field,)
    name = next((name for name in names if name in columns and columns[name].dtype.kind in "fiu"), None)
    if name is None:
        return None, ""
    try:
        return offsets_s(name, columns[name], keep, stamp_ns, point_time)
    except DecodeError as error:
        if error.reason != Refusal.CLOUD_TIME:
            raise
        return None, f"{name}: not near the stamp of the sweep in any unit, and not used"


def _columns(path: Path, layout: CloudLayout) -> tuple[Columns, tuple[Recognition, ...]]:
    """The columns of a file, and what was recognised of them."""
    match path.suffix.lower():
        case ".pcd":
            data = read_bytes(path)
            return _fields(parse_pcd(data)), _of_viewpoint(viewpoint_of(data), path)
        case ".ply":
            return _fields(parse_ply(read_bytes(path))), ()
        case ".las" | ".laz":
            return columns_of_las(read_bytes(path), path, MAX_POINTS), ()
        case ".bin":
            data = read_bytes(path)
            names = layout.columns or _columns_of_bin(path, np.frombuffer(data, np.uint8))
            width = 4 * len(names)
            if len(data) % width:
                what = f"{path} is truncated: a point of {width} bytes (float32 {' '.join(names)}) is cut"
                raise SourceError(f"{what} at byte {len(data) - len(data) % width}")
            return _named(np.frombuffer(data, "<f4").reshape(-1, len(names)), names), _of_columns(names, layout)
        case ".npy":
            return _of_npy(path, layout)
        case ".npz":
            return _of_npz(path), ()
        case _:
            raise SourceError(f"{path}: clouds are .pcd, .ply, .las, .bin, .npy or .npz files")


def _of_viewpoint(viewpoint: str, path: Path) -> tuple[Recognition, ...]:
    if not viewpoint:
        return ()
    text = (
        f"Points are taken as they stand: the VIEWPOINT {viewpoint} of {path.name} is not applied. If a tool has moved "
        "the points by it (CloudCompare), state the LiDAR's pose in them as `T_cloud_lidar`."
    )
    return (Recognition("viewpoint", text, "warn"),)


def _of_columns(names: tuple[str, ...], layout: CloudLayout) -> tuple[Recognition, ...]:
    if names in (layout.columns, XYZI, XYZI[:3]):
        return ()
    unused = f" ({UNUSED} is not used)" if UNUSED in names else ""
    text = f"Clouds are read as {' '.join(names)}{unused}; if that is wrong, say `cloud_columns:`."
    return (Recognition("cloud_columns", text),)


def _fields(table: NDArray[Any]) -> Columns:
    """The fields of a table with one number a point, by their names without the prefix of CloudCompare."""
    columns: dict[str, NDArray[Any]] = {}
    for name in table.dtype.names or ():
        if table[name].ndim == 1 and table[name].dtype.kind in "fiu":
            columns.setdefault(name.lower().removeprefix("scalar_"), table[name])
    return columns


def _named(table: NDArray[Any], names: Sequence[str]) -> Columns:
    return {name: table[:, place] for place, name in enumerate(names) if name != UNUSED}


def _of_npy(path: Path, layout: CloudLayout) -> tuple[Columns, tuple[Recognition, ...]]:
    table = read_npy(path)
    if table.dtype.names and table.ndim == 1:
        columns = _fields(table)
        if {"x", "y", "z"} <= columns.keys():
            return columns, ()
    elif table.ndim == 2 and table.dtype.kind == "f" and 3 <= table.shape[1] <= MAX_COLUMNS:
        names = layout.columns or _column_names(table)
        if len(names) == table.shape[1]:
            return _named(table, names), _of_columns(names, layout)
        raise SourceError(f"{path} has {table.shape[1]} columns, not {len(names)} ({' '.join(names)})")
    raise SourceError(f"{path}: expected float (N, 3) or more columns, x y z [intensity ...], or fields x, y and z")


_NPZ_KINDS = {"xyz": "f", "intensity": "fiu", "ring": "iu", _WRITTEN_OFFSET: "f"}


def _of_npz(path: Path) -> Columns:
    columns = read_npz(path, _NPZ_KINDS)
    xyz = columns.pop("xyz", None)
    if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise SourceError(f"{path}: expected an array `xyz` of floats, of shape (N, 3)")
    for name, values in columns.items():
        if values.dtype.kind not in _NPZ_KINDS[name] or values.shape != xyz.shape[:1]:
            raise SourceError(f"{path}: array `{name}` has shape {values.shape} and type {values.dtype}")
    return {**columns, **_named(xyz, "xyz")}


# --- tables without names -------------------------------------------------------------------------------------

_WIDTHS: Final = (4, 5, 6)
"""Floats of a point in the files of data sets; three if none of these fit."""

JUDGED_ROWS: Final = 20_000
"""Rows by which a number of columns is judged."""

TELLING_ROWS: Final = 1000
"""Fewest rows whose distribution tells columns apart. Of a smaller table, KITTI's four columns are assumed if its
values allow it."""

ALIKE: Final = 0.1
"""Largest distance of two distributions (Kolmogorov-Smirnov) that count as one. Of 1000 rows from one distribution the
distance is below 0.09 in 99.9 % of cases (1.95·√(2/n)); coordinates and intensities of a sweep are 0.3 apart."""

LARGEST_M: Final = 1e7
"""Largest coordinate, metres. Bytes that are no float32 have any size, most of them beyond it or next to zero."""

SMALLEST_M: Final = 1e-12
"""Smallest coordinate other than zero, metres."""

MOST_STRAY: Final = 0.01
"""Largest share of coordinates beyond these two."""

MOST_RINGS: Final = 1024

WITHIN_RING: Final = 0.25
"""Largest variance of the elevations within rings, as a share of that of all points. A beam has one elevation."""


def _columns_of_bin(path: Path, data: NDArray[np.uint8]) -> tuple[str, ...]:
    """The names of the columns of float32 in a file.

    Raises:
        SourceError: no number of columns fits, or several do.
    """
    floats = data[: len(data) - len(data) % 4].view("<f4")
    whole = [width for width in _WIDTHS if len(data) % (4 * width) == 0]
    fitting = [width for width in whole if _may_be_points(floats.reshape(-1, width))]
    if not fitting and len(data) % 12 == 0 and _may_be_points(floats.reshape(-1, 3)):
        fitting = [3]
    if 4 in fitting and floats.size < 4 * TELLING_ROWS:
        fitting = [4]
    if len(fitting) > 1:
        counts = " or ".join(map(str, fitting))
        raise SourceError(
            f"{path} may hold {counts} float32 a point: say what they are with `cloud_columns: [x, y, z, intensity]` "
            "in the dataset.yaml (ring, time, and _ for a column that is not used)"
        )
    if not fitting and whole:
        raise SourceError(
            f"{path} is no table of 3 to 6 float32 a point, x y z first: say what the columns are with "
            "`cloud_columns: [x, y, z, intensity]` in the dataset.yaml, or write a .npy or .pcd"
        )
    width = fitting[0] if fitting else len(XYZI)
    return XYZI if width == len(XYZI) else _column_names(floats[: floats.size // width * width].reshape(-1, width))


def _some(table: NDArray[Any]) -> NDArray[Any]:
    """At most `JUDGED_ROWS` rows, randomly selected: those at even distances would hit the same column again and again
    if the table has another width."""
    if len(table) <= JUDGED_ROWS:
        return table
    return np.asarray(table[np.random.default_rng(0).integers(0, len(table), JUDGED_ROWS)])


def _may_be_points(table: NDArray[np.float32]) -> bool:
    """Whether rows of this length may be points: coordinates of a size, intensities above zero, and columns that are
    not all distributed alike."""
    rows = _some(table)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) == 0:
        return True
    size = np.abs(rows[:, :3])
    stray = (size > LARGEST_M) | ((size > 0.0) & (size < SMALLEST_M))
    if stray.mean() > MOST_STRAY or (rows.shape[1] > 3 and rows[:, 3].min() < 0.0):
        return False
    return len(rows) < TELLING_ROWS or _most_unlike(rows) > ALIKE


def _most_unlike(rows: NDArray[np.float32]) -> float:
    """The largest distance of the distributions of two columns."""
    ordered = np.sort(rows, axis=0)
    first = ordered[:, 0]
    places = np.concatenate([ordered[:, other] for other in range(rows.shape[1])])
    shares = [np.searchsorted(ordered[:, other], places, "right") / len(first) for other in range(rows.shape[1])]
    return float(max(np.abs(one - other).max() for one in shares for other in shares))


def _column_names(table: NDArray[Any]) -> tuple[str, ...]:
    """x y z, intensity if there is a fourth column, and ring if the fifth holds rings. Three whole numbers behind the
    coordinates that are no rings are a colour, and no intensity."""
    width = table.shape[1]
    if width <= len(XYZI):
        return XYZI[:width]
    some = np.asarray(_some(table), dtype=np.float64)
    if _are_rings(some[:, 4], some[:, :3]):
        return (*XYZI, "ring", *(UNUSED,) * (width - 5))
    is_colour = width >= 6 and all(_are_whole(some[:, column]) for column in (3, 4, 5))
    return ("x", "y", "z", *(UNUSED,) * (width - 3)) if is_colour else (*XYZI, *(UNUSED,) * (width - 4))


def _are_whole(values: NDArray[Any]) -> bool:
    finite = values[np.isfinite(values)]
    return bool(finite.size and (finite == np.rint(finite)).all() and finite.min() >= 0 and finite.max() < MOST_RINGS)


def _are_rings(values: NDArray[Any], xyz_m: NDArray[Any]) -> bool:
    """Whether numbers (N,) are those of beams: whole, several, and each with its own elevation."""
    if not _are_whole(values):
        return False
    keep = np.isfinite(xyz_m).all(axis=1) & np.isfinite(values)
    range_m = lengths(np.ascontiguousarray(xyz_m[keep], dtype=np.float32))
    seen = range_m > 0.0
    ring = values[keep][seen].astype(np.int64)
    sine = xyz_m[keep][seen][:, 2] / range_m[seen]
    count = np.bincount(ring)
    if (count > 0).sum() < 2:
        return False
    mean = np.bincount(ring, sine) / np.maximum(count, 1)
    return bool(np.mean((sine - mean[ring]) ** 2) <= WITHIN_RING * np.var(sine))
