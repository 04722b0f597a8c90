"""Point clouds from files: `.bin`, `.npy`, `.npz`, and the formats of `cloud_formats`.

A `.bin` is a table of float32 that does not say how many belong to a point: KITTI has four (x y z intensity), nuScenes
five (and ring), others three or six. The number is recognised from the values. With a wrong number each column mixes
what belongs to several, so that intensities are negative and all columns are distributed alike. If two numbers fit, the
file is refused until `cloud_columns` says which is right. What stands in further columns is recognised, too: ring
numbers are whole and each has one elevation; any other column is left out.

Times of points are recognised as those of `PointCloud2` are, see `ros.point_clouds`. Rows with a non-finite coordinate
are dropped together with their intensity, ring and time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import NO_SCAN_LINES, OriginCheck, from_origin, unordered
from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.config import PointTimeConfig
from coec.errors import DecodeError, MisreadError, SourceError
from coec.geometry.points import lengths
from coec.io.frame_validation import Refusal, finite_rows
from coec.io.numpy_files import read_npy, read_npz
from coec.io.recordings.cloud_formats import MAX_POINTS, TableError, columns_of_las, parse_pcd, parse_ply, viewpoint_of
from coec.io.ros.point_clouds import FIELDS, REFLECTANCE_FIELDS, offsets_s, time_field
from coec.io.user_files import read_bytes

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
        MisreadError: the points are in millimetres, or were not measured from the origin of that frame. The message of
            the latter ends with the entry of `advice` for the cause.
    """
    sweep = from_origin(cloud, T_cloud_lidar, frame_id)
    if checked is not None:
        return unordered(sweep) if NO_SCAN_LINES in checked.recognitions else sweep
    median_m = float(np.median(lengths(sweep.xyz_m))) if len(sweep.xyz_m) else 0.0
    if median_m > FARTHEST_MEDIAN_M:
        raise MisreadError(
            f"{where}: half of the points are farther than {median_m:.0f} m: coordinates are in metres, "
            "from the LiDAR, so divide millimetres by 1000, and write points of a map in the frame of the LiDAR"
        )
    check = OriginCheck()
    contradiction = check.inspect(sweep)
    if contradiction is not None:
        raise MisreadError(f"{where}: {contradiction.sentence} {advice[contradiction.cause]}")
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
    intensity, ring = (
        next((columns[name] for name in names if name in columns), None) for names in (REFLECTANCE_FIELDS, _RINGS)
    )
    if ring is not None and (ring.dtype.kind not in "iu" or int(ring.max()) > 0xFFFF or int(ring.min()) < 0):
        # Its name says that it holds rings; whether they are scan lines depends on the frame of the points.
        ring = ring if np.isfinite(ring[keep]).all() and _are_whole(ring[keep]) else None
    return LidarFrame(
        stamp_ns,
        frame_id,
        xyz_m[keep],
        intensity=None if intensity is None else intensity[keep].astype(np.float32),
        ring=None if ring is None else ring[keep].astype(np.uint16),
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
    timed = {name: columns[name] for name in names if name in columns and columns[name].dtype.kind in "fiu"}
    name = next(iter(timed), None) if point_time is not None else time_field(timed, keep, stamp_ns)
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
            return columns_of_las(read_bytes(path), path), ()
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
