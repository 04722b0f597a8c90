"""Point clouds from files: `.bin`, `.npy`, `.npz`, and PCD v0.7 (Point Cloud Library) in ascii, binary and
binary_compressed, with bounds on every size; `pypcd4` allocates what a header claims.

Rows with a non-finite coordinate are dropped together with their intensity, ring and time.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import OriginCheck, from_origin, unordered
from coec.calibration.types import LidarFrame, Matrix4
from coec.errors import SourceError
from coec.geometry.points import lengths
from coec.io.user_files import read_bytes, read_npy, read_npz

Columns = dict[str, NDArray[np.generic]]
"""`xyz` (N, 3), and if the file has them `intensity`, `ring` and `time_offset_s`, each (N,). Not filtered."""

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

_TIME_FIELDS = ("t", "time", "time_offset_s")
"""Names of the time field. Integers are nanoseconds after the stamp (`t` of Ouster), floats are seconds after it
(Velodyne driver)."""

_NS = 1e-9


class PcdError(ValueError):
    """What is wrong, with the line or byte where."""


@dataclass(frozen=True, slots=True)
class _Header:
    point: np.dtype[np.void]
    points: int
    encoding: str
    body: int
    body_line: int


def parse_pcd(data: bytes) -> Columns:
    """The columns of a PCD file.

    Raises:
        PcdError: the file is not PCD, is truncated or contradicts itself; the message begins with the line or byte.
    """
    header = _parse_header(data)
    match header.encoding:
        case "ascii":
            table = _ascii_table(data, header)
        case "binary":
            need = header.points * header.point.itemsize
            have = len(data) - header.body
            if have < need:
                raise PcdError(f"byte {len(data)}: the file ends after {have} of {need} bytes of points")
            table = np.frombuffer(data, header.point, header.points, header.body)
        case _:
            table = _decompressed_table(data, header)
    return _columns(table)


def _parse_header(data: bytes) -> _Header:
    values: dict[str, list[str]] = {}
    start = line_number = 0
    while "DATA" not in values:
        end = data.find(b"\n", start, MAX_HEADER_BYTES)
        line_number += 1
        if end < 0:
            raise PcdError(f"line {line_number}: the header ends without a DATA line")
        try:
            tokens = data[start:end].decode("ascii").split()
        except UnicodeDecodeError as error:
            raise PcdError(f"line {line_number}: not a PCD header") from error
        if tokens and not tokens[0].startswith("#"):
            values[tokens[0]] = tokens[1:]
        start = end + 1

    def integers(key: str, count: int | None = None) -> list[int]:
        try:
            numbers = [int(value) for value in values[key]]
        except (KeyError, ValueError) as error:
            raise PcdError(f"line {line_number}: the header has no valid {key}") from error
        if (count is not None and len(numbers) != count) or any(not 0 <= number < 2**63 for number in numbers):
            raise PcdError(f"line {line_number}: the header has no valid {key}")
        return numbers

    names = values.get("FIELDS", [])
    sizes, types = integers("SIZE", len(names)), values.get("TYPE", [])
    counts = integers("COUNT", len(names)) if "COUNT" in values else [1] * len(names)
    width, height = integers("WIDTH", 1)[0], integers("HEIGHT", 1)[0]
    points = integers("POINTS", 1)[0] if "POINTS" in values else width * height
    if points != width * height or points > MAX_POINTS:
        raise PcdError(f"line {line_number}: {points} POINTS do not agree with {width} x {height}, or are too many")
    if len(names) > MAX_FIELDS:
        raise PcdError(f"line {line_number}: {len(names)} FIELDS; more than {MAX_FIELDS} do not come from a LiDAR")
    encoding = (values["DATA"] or [""])[0]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise PcdError(f"line {line_number}: DATA must be ascii, binary or binary_compressed")
    point = _point_type(names, sizes, types, counts, line_number)
    most = MAX_UNPACKED_BYTES if encoding == "binary_compressed" else MAX_TABLE_BYTES
    if points * point.itemsize > most:
        raise PcdError(
            f"line {line_number}: {points} points of {point.itemsize} bytes are more than the {most} bytes that "
            f"are read as {encoding}"
        )
    return _Header(point, points, encoding, start, line_number)


def _point_type(
    names: list[str], sizes: list[int], types: list[str], counts: list[int], line: int
) -> np.dtype[np.void]:
    """The packed row of one point. Padding fields (`_`) and repeated names get a name of their own."""
    if len(types) != len(names) or any(not 1 <= repeats <= 4096 for repeats in counts):
        raise PcdError(f"line {line}: FIELDS, SIZE, TYPE and COUNT do not agree")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    free = (f"_{number}" for number in itertools.count() if f"_{number}" not in names)
    for place, (name, size, kind, repeats) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if (kind, size) not in {("F", 4), ("F", 8), *((k, s) for k in "IU" for s in (1, 2, 4, 8))}:
            raise PcdError(f"line {line}: field {name} has unknown type {kind}{size}")
        unique = name if name != "_" and name not in names[:place] else next(free)
        fields.append((unique, f"<{kind.lower()}{size}", (repeats,) if repeats > 1 else ()))
    missing = [axis for axis in "xyz" if axis not in names or counts[names.index(axis)] != 1]
    if missing:
        raise PcdError(f"line {line}: FIELDS lacks {' '.join(missing)}")
    return np.dtype(fields)


def _ascii_table(data: bytes, header: _Header) -> NDArray[np.void]:
    """The table from rows of numbers, block by block. NumPy reads a block at once; only if that fails are its lines
    checked one by one."""
    table = np.zeros(header.points, header.point)
    begin = 0
    for lines in _blocks(data, header):
        first_line = header.body_line + 1 + begin
        table[begin : begin + len(lines)] = _ascii_rows(lines, header.point, first_line)
        begin += len(lines)
    if begin < header.points:
        raise PcdError(f"line {header.body_line + begin}: the file ends after {begin} of {header.points} points")
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
            raise PcdError(f"line {header.body_line + 1 + header.points - left}: longer than {MAX_LINE_BYTES} bytes")
        lines.append(line.decode("ascii", errors="replace"))
        held += len(line)
        left -= 1
        if held >= ASCII_BLOCK_BYTES:
            yield lines
            lines, held = [], 0
    while lines and not lines[-1].strip():
        lines.pop()
    yield lines


def _ascii_rows(lines: list[str], point: np.dtype[np.void], first_line: int) -> NDArray[np.void]:
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
        raise PcdError(f"line {number}: expected {width} numbers, found {len(tokens)}")
    for token in tokens:
        try:
            float(token)
        except ValueError as error:
            raise PcdError(f"line {number}: not a number") from error


def _bounded(values: NDArray[np.float64], dtype: np.dtype[np.generic], first_line: int) -> NDArray[np.float64]:
    """The values, checked to be in the range of their integer type, because a cast of others would be undefined."""
    limits = np.iinfo(dtype.type)  # type: ignore[type-var]
    # The largest 64-bit integer is not a double, and rounds to one that is out of range.
    fits = (values >= limits.min) & (values <= limits.max) & (values < float(limits.max) + 1.0)
    bad = ~fits
    if bad.any():
        raise PcdError(f"line {first_line + int(np.argwhere(bad)[0, 0])}: a value does not fit its type {dtype}")
    return values


def _decompressed_table(data: bytes, header: _Header) -> NDArray[np.void]:
    """The table from LZF-compressed columns, which PCL stores one after another, not by row."""
    start = header.body + 8
    if len(data) < start:
        raise PcdError(f"byte {len(data)}: the file ends before the size of its compressed points")
    packed, unpacked = np.frombuffer(data, "<u4", 2, header.body).tolist()
    if unpacked != header.points * header.point.itemsize:
        raise PcdError(f"byte {header.body}: {unpacked} bytes are promised, the header needs {header.points} points")
    if packed > unpacked + unpacked // 25 + 64:  # liblzf's own worst case is 104 %
        raise PcdError(f"byte {header.body}: {packed} compressed bytes for {unpacked}: no compression makes them more")
    if len(data) < start + packed:
        raise PcdError(f"byte {len(data)}: the file ends after {len(data) - start} of {packed} compressed bytes")
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
                raise PcdError(f"byte {at}: damaged compressed points (a run passes the end)")
            out += data[at : at + run]
            at += run
        else:
            length = control >> 5
            if at + (2 if length == 7 else 1) > end:
                raise PcdError(f"byte {at}: damaged compressed points (a reference is cut)")
            if length == 7:
                length += data[at]
                at += 1
            distance = ((control & 31) << 8 | data[at]) + 1
            at += 1
            length += 2
            begin = len(out) - distance
            if begin < 0:
                raise PcdError(f"byte {at}: damaged compressed points (a reference before the start)")
            if distance >= length:
                out += out[begin : begin + length]
            else:  # the reference overlaps what it writes: the last `distance` bytes repeat
                out += (bytes(out[begin:]) * (length // distance + 1))[:length]
        if len(out) > size:
            raise PcdError(f"byte {at}: damaged compressed points (more than the {size} bytes promised)")
    if len(out) != size:
        raise PcdError(f"byte {end}: damaged compressed points ({len(out)} of {size} bytes)")
    return bytes(out)


def _columns(table: NDArray[np.void]) -> Columns:
    names = table.dtype.names or ()
    with np.errstate(over="ignore", invalid="ignore"):
        return _picked(table, names)


def _picked(table: NDArray[np.void], names: tuple[str, ...]) -> Columns:
    columns: Columns = {"xyz": np.stack([table[axis].astype(np.float32) for axis in "xyz"], axis=1)}
    if "intensity" in names and table["intensity"].ndim == 1:
        columns["intensity"] = table["intensity"].astype(np.float32)
    if "ring" in names and table["ring"].ndim == 1 and table["ring"].dtype.kind in "iu":
        columns["ring"] = table["ring"].astype(np.uint16)
    for name in _TIME_FIELDS:
        if name in names and table[name].ndim == 1:
            scale = _NS if table[name].dtype.kind in "iu" else 1.0
            columns["time_offset_s"] = (table[name].astype(np.float64) * scale).astype(np.float32)
            break
    return columns


VELODYNE_POINT_BYTES = 16
"""x, y, z, reflectance as little-endian float32 (KITTI development kit)."""


def load_cloud(stamp_ns: int, frame_id: str, path: Path) -> LidarFrame:
    """A sweep from a `.pcd`, `.bin`, `.npy` or `.npz` file, by its suffix.

    `.npy` holds (N, 3) or (N, 4): x y z [intensity]. `.npz` holds `xyz` (N, 3) and may hold `intensity`, `ring` and
    `time_offset_s`, each (N,). Metres, seconds after `stamp_ns`.

    Raises:
        SourceError: unreadable, truncated, malformed or empty; names file, line or byte.
    """
    loader = {".pcd": _load_pcd, ".bin": _load_bin, ".npy": _load_npy, ".npz": _load_npz}.get(path.suffix.lower())
    if loader is None:
        raise SourceError(f"{path}: clouds are .pcd, .bin, .npy or .npz files")
    columns = loader(path)
    if len(columns["xyz"]) > MAX_POINTS:
        raise SourceError(f"{path} has {len(columns['xyz'])} points; no sweep has more than {MAX_POINTS}")
    # A double that is too large for a float becomes infinite, and its point is dropped.
    with np.errstate(over="ignore", invalid="ignore"):
        return _frame(stamp_ns, frame_id, path, columns)


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
) -> LidarFrame:
    """A sweep in the LiDAR's own frame, see `from_origin`; without ring numbers that are no scan lines, unless
    a person says that they are (`has_scan_lines`).

    Raises:
        SourceError: the points are in millimetres, or were not measured from the origin of that frame. The message of
            the latter ends with the entry of `advice` for the cause.
    """
    sweep = from_origin(cloud, T_cloud_lidar, frame_id)
    median_m = float(np.median(lengths(sweep.xyz_m))) if len(sweep.xyz_m) else 0.0
    if median_m > FARTHEST_MEDIAN_M:
        raise SourceError(
            f"{where}: half of the points are farther than {median_m:.0f} m: coordinates are in metres, "
            "so divide millimetres by 1000"
        )
    check = OriginCheck()
    contradiction = check.inspect(sweep)
    if contradiction is not None:
        raise SourceError(f"{where}: {contradiction.sentence} {advice[contradiction.cause]}")
    return sweep if has_scan_lines or check.has_scan_lines(sweep) else unordered(sweep)


def _frame(stamp_ns: int, frame_id: str, path: Path, columns: Columns) -> LidarFrame:
    xyz_m = np.ascontiguousarray(columns["xyz"], dtype=np.float32)
    keep = np.isfinite(xyz_m).all(axis=1)
    if "time_offset_s" in columns:
        keep &= np.isfinite(columns["time_offset_s"].astype(np.float32))
    if not keep.any():
        raise SourceError(f"{path} holds no finite point ({len(xyz_m)} rows)")
    intensity, ring, time_offset_s = (
        None if values is None else values[keep] for values in map(columns.get, ("intensity", "ring", "time_offset_s"))
    )
    return LidarFrame(
        stamp_ns,
        frame_id,
        xyz_m[keep],
        intensity=None if intensity is None else intensity.astype(np.float32),
        ring=None if ring is None else ring.astype(np.uint16),
        time_offset_s=None if time_offset_s is None else time_offset_s.astype(np.float32),
        not_finite=int((~keep).sum()),
    )


def _load_bin(path: Path) -> Columns:
    data = read_bytes(path)
    if len(data) % VELODYNE_POINT_BYTES:
        whole = len(data) - len(data) % VELODYNE_POINT_BYTES
        raise SourceError(f"{path} is truncated: a point of 16 bytes (float32 x y z i) is cut at byte {whole}")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    return {"xyz": points[:, :3], "intensity": points[:, 3]}


def _load_npy(path: Path) -> Columns:
    points = read_npy(path)
    if points.ndim != 2 or points.shape[1] not in (3, 4) or points.dtype.kind != "f":
        raise SourceError(f"{path}: expected float (N, 3) or (N, 4), x y z [intensity]")
    columns: Columns = {"xyz": np.asarray(points[:, :3])}
    if points.shape[1] == 4:
        columns["intensity"] = np.asarray(points[:, 3])
    return columns


_NPZ_KINDS = {"xyz": "f", "intensity": "fiu", "ring": "iu", "time_offset_s": "f"}


def _load_npz(path: Path) -> Columns:
    columns = read_npz(path, _NPZ_KINDS)
    xyz = columns.get("xyz")
    if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3:
        raise SourceError(f"{path}: expected an array `xyz` of shape (N, 3)")
    for name, values in columns.items():
        if values.dtype.kind not in _NPZ_KINDS[name] or (name != "xyz" and values.shape != xyz.shape[:1]):
            raise SourceError(f"{path}: array `{name}` has shape {values.shape} and type {values.dtype}")
    return columns


def _load_pcd(path: Path) -> Columns:
    try:
        return parse_pcd(read_bytes(path))
    except PcdError as error:
        raise SourceError(f"{path}, {error}") from error
