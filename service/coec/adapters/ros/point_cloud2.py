"""Converts `sensor_msgs/PointCloud2` to sweeps and back, with any order of fields, padding and organisation, and one
copy per column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_humble import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointField as PointField
from rosbags.typesys.stores.ros2_humble import std_msgs__msg__Header as Header

from coec.adapters.frames.incoming import Refusal, finite_rows, lidar_frame
from coec.adapters.ros.point_time import FIELDS as TIME_FIELDS
from coec.adapters.ros.point_time import offsets_s, stamp_in
from coec.adapters.ros.source_field import points_of_source
from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig, PointTimeConfig
from coec.errors import DecodeError

_DTYPES: dict[int, np.dtype[Any]] = {
    PointField.INT8: np.dtype("i1"),
    PointField.UINT8: np.dtype("u1"),
    PointField.INT16: np.dtype("<i2"),
    PointField.UINT16: np.dtype("<u2"),
    PointField.INT32: np.dtype("<i4"),
    PointField.UINT32: np.dtype("<u4"),
    PointField.FLOAT32: np.dtype("<f4"),
    PointField.FLOAT64: np.dtype("<f8"),
}

_XYZ_BYTES = np.dtype("V12")
"""x y z as float32."""


def frame_of(
    message: PointCloud2,
    stamp_ns: int,
    limits: LimitsConfig,
    *,
    point_time: PointTimeConfig | None = None,
    source: int | None = None,
) -> LidarFrame:
    """The sweep of a message whose header is already checked.

    `x y z` may be float32 or float64; `intensity` any number; `ring` (or `channel`, `line`) an unsigned integer. The
    time is one of `TIME_FIELDS`, any number, read as recognised in `point_time` or as the argument `point_time` says.
    Optional fields of other types are left out, and so are fields with several values per point. A `stamp_ns` of 0
    means no stamp; then the first point gives it, if it has a time of day. `source`: see `of_source`.

    Raises:
        DecodeError: `cloud_shape`, `cloud_fields`, `cloud_too_large`, `cloud_empty`, `cloud_time`,
        `cloud_time_ambiguous`, `cloud_concatenated`.
    """
    _check_layout(message, limits)
    message = points_of_source(message, source)
    by_name = {field.name: field for field in reversed(message.fields)}  # the first field of a name counts
    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 become infinite and are dropped
        xyz_m = _positions(message, by_name)
        intensity = _column(message, by_name.get("intensity"), "fiu")
        ring = _column(message, next((by_name[n] for n in ("ring", "channel", "line") if n in by_name), None), "u")
        if ring is not None and ring.itemsize > 2 and int(ring.max()) > 0xFFFF:
            raise DecodeError(Refusal.CLOUD_FIELDS, "a ring number exceeds 65535")
        times = _times(message, by_name, finite_rows(xyz_m), stamp_ns, point_time)
        return lidar_frame(
            times.stamp_ns,
            message.header.frame_id,
            xyz_m,
            None if intensity is None else intensity.astype(np.float32),
            None if ring is None else ring.astype(np.uint16),
            times.offset_s,
            timed_by=times.description,
        )


WRITTEN_TIME: Final = PointTimeConfig(field="time", unit="s", base="stamp")
"""How `message_of` writes the times of points, as Velodyne does."""


def message_of(frame: LidarFrame) -> PointCloud2:
    """The message that `frame_of` reads back to an equal sweep; without padding, with points timed as
    `WRITTEN_TIME`."""
    given = [
        ("x", frame.xyz_m[:, 0], PointField.FLOAT32),
        ("y", frame.xyz_m[:, 1], PointField.FLOAT32),
        ("z", frame.xyz_m[:, 2], PointField.FLOAT32),
        ("intensity", frame.intensity, PointField.FLOAT32),
        ("ring", frame.ring, PointField.UINT16),
        (WRITTEN_TIME.field, frame.time_offset_s, PointField.FLOAT32),
    ]
    columns = [(name, values, datatype) for name, values, datatype in given if values is not None]
    rows = np.empty(len(frame.xyz_m), np.dtype([(name, _DTYPES[datatype]) for name, _, datatype in columns]))
    fields = []
    offset = 0
    for name, values, datatype in columns:
        rows[name] = values
        fields.append(PointField(name, offset, datatype, 1))
        offset += _DTYPES[datatype].itemsize
    seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
    return PointCloud2(
        header=Header(Time(seconds, nanoseconds), frame.frame_id),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=offset,
        row_step=offset * len(rows),
        data=rows.view(np.uint8),
        is_dense=True,
    )


def _check_layout(message: PointCloud2, limits: LimitsConfig) -> None:
    """Checks the sizes, in Python integers, which do not overflow."""
    count = message.width * message.height
    if count > limits.max_points:
        raise DecodeError(Refusal.CLOUD_TOO_LARGE, f"{count} points; limits.max_points is {limits.max_points}")
    if count == 0:
        raise DecodeError(Refusal.CLOUD_EMPTY, "the cloud has no point")
    if (
        message.point_step == 0
        or message.row_step < message.width * message.point_step
        or message.data.size < (message.height - 1) * message.row_step + message.width * message.point_step
    ):
        raise DecodeError(
            Refusal.CLOUD_SHAPE,
            f"{message.height}×{message.width} points of {message.point_step} bytes, rows {message.row_step} apart, "
            f"do not fit into {message.data.size} bytes",
        )


def _positions(message: PointCloud2, by_name: Mapping[str, PointField]) -> NDArray[np.float32]:
    """(N, 3) x y z."""
    together = _contiguous_positions(message, by_name)
    if together is not None:
        return together
    xyz_m = np.empty((message.width * message.height, 3), np.float32)
    for i, axis in enumerate("xyz"):
        column = _column(message, by_name.get(axis), "f")
        if column is None:
            raise DecodeError(Refusal.CLOUD_FIELDS, "the cloud needs the fields x, y, z as float32 or float64")
        xyz_m[:, i] = column
    return xyz_m


def _contiguous_positions(message: PointCloud2, by_name: Mapping[str, PointField]) -> NDArray[np.float32] | None:
    """x y z in the layout of most drivers, float32 one after the other. Copying the three together takes a third of the
    time of single columns. None for any other layout."""
    x = by_name.get("x")
    if x is None or x.offset + _XYZ_BYTES.itemsize > message.point_step:
        return None
    for i, axis in enumerate("xyz"):
        field = by_name.get(axis)
        if field is None or (field.datatype, field.offset) != (PointField.FLOAT32, x.offset + 4 * i) or field.count > 1:
            return None
    places = np.ascontiguousarray(_view(message, _XYZ_BYTES, x.offset))
    return places.view(">f4" if message.is_bigendian else "<f4").reshape(-1, 3).astype(np.float32, copy=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Times:
    """The stamp of a sweep, the times of its points, and how they were read.

    Attributes:
        stamp_ns: that of the header; if it has none, that of the first point, if points have a time of day.
        offset_s: (N,) seconds after the stamp; None if no field holds a time.
        told: see `LidarFrame.timed_by`.
    """

    stamp_ns: int
    offset_s: NDArray[np.float32] | None
    description: str


def _times(
    message: PointCloud2,
    by_name: Mapping[str, PointField],
    keep: NDArray[np.bool_] | None,
    stamp_ns: int,
    configured: PointTimeConfig | None,
) -> _Times:
    """`keep` as in `offsets_s`."""
    names = TIME_FIELDS if configured is None else (configured.field,)
    name = next((name for name in names if name in by_name), None)
    column = None if name is None else _column(message, by_name[name], "fiu")
    if name is None or column is None:
        return _Times(stamp_ns, None, "")
    first_ns = None if stamp_ns else stamp_in(column, keep, configured)
    offset_s, description = offsets_s(name, column, keep, first_ns or stamp_ns, configured)
    if first_ns is None:
        return _Times(stamp_ns, offset_s, description)
    return _Times(first_ns, offset_s, f"{description}; without a stamp, that of the first point is taken")


def _column(message: PointCloud2, field: PointField | None, kinds: str) -> NDArray[Any] | None:
    """(N,) values of a field; None if it is absent or not of these NumPy kinds."""
    if field is None or field.datatype not in _DTYPES or _DTYPES[field.datatype].kind not in kinds:
        return None
    if field.count > 1:  # some drivers write 0 for 1
        return None
    dtype = _DTYPES[field.datatype].newbyteorder(">" if message.is_bigendian else "<")
    if field.offset + dtype.itemsize > message.point_step:
        raise DecodeError(Refusal.CLOUD_SHAPE, "a field lies outside its point")
    return _view(message, dtype, field.offset).reshape(-1)


def _view(message: PointCloud2, dtype: np.dtype[Any], offset: int) -> NDArray[Any]:
    """(height, width) values at an offset in each point; the caller has checked that they fit."""
    return np.ndarray(
        shape=(message.height, message.width),
        dtype=dtype,
        buffer=message.data,
        offset=offset,
        strides=(message.row_step, message.point_step),
    )
