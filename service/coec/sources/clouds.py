"""Point clouds from files: `.bin`, `.npy`, `.npz` here, `.pcd` in `pcd.py`.

Rows with a non-finite coordinate are dropped together with their intensity, ring and time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from coec.calibration.frames.origin import apparent_origin, from_origin
from coec.calibration.types import LidarFrame, Matrix4
from coec.errors import SourceError
from coec.sources.pcd import MAX_POINTS, Columns, PcdError, parse_pcd
from coec.sources.reading import read_bytes, read_npy, read_npz

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


def measured_from(
    cloud: LidarFrame, T_cloud_lidar: Matrix4, frame_id: str, where: Path, advice: Mapping[str, str]
) -> LidarFrame:
    """A sweep in the LiDAR's own frame, see `from_origin`.

    Raises:
        SourceError: the points were not measured from the origin of that frame. The message ends with the entry of
            `advice` for the cause.
    """
    sweep = from_origin(cloud, T_cloud_lidar, frame_id)
    contradiction = apparent_origin(sweep)
    if contradiction is not None:
        raise SourceError(f"{where}: {contradiction.sentence} {advice[contradiction.cause]}")
    return sweep


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
