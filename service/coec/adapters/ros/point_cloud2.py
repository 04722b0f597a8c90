"""`sensor_msgs/PointCloud2` to sweeps and back: any order of fields, padding and organisation, one copy per
column."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_humble import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointField as PointField
from rosbags.typesys.stores.ros2_humble import std_msgs__msg__Header as Header

from coec.adapters.frames.incoming import MAX_TIME_OFFSET_S, Refusal, finite_rows, lidar_frame
from coec.adapters.ros.source_field import of_source
from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
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

_TIME_FIELDS = ("t", "time", "timestamp", "time_offset", "time_stamp", "offset_time")
"""As drivers name it: Ouster `t` (u32, ns), Velodyne `time` (f32, s), Hesai `timestamp` (f64, s since 1970),
Livox `timestamp` (f64, ns since 1970) and `offset_time` (u32, ns)."""

_RELATIVE_S = 1.0
"""A float time up to this is relative to the stamp: ten revolutions of a usual LiDAR, and no clock since
1970."""


def frame_of(message: PointCloud2, stamp_ns: int, limits: LimitsConfig, *, source: int | None = None) -> LidarFrame:
    """The sweep of a message whose header is already checked.

    `x y z` may be float32 or float64; `intensity` any number; `ring` (or `channel`, `line`) an unsigned
    integer; time one of `_TIME_FIELDS`: integers are nanoseconds after the stamp; floats are seconds after
    the stamp, seconds since 1970 or nanoseconds since 1970, whichever brings them to the stamp. Optional
    fields of other types are left out. `source`: see `of_source`.

    Raises:
        DecodeError: `cloud_big_endian`, `cloud_shape`, `cloud_fields`, `cloud_too_large`, `cloud_empty`,
        `cloud_time`, `cloud_concatenated`.
    """
    _check_layout(message, limits)
    message = of_source(message, source)
    by_name = {field.name: field for field in reversed(message.fields)}  # the first of a name counts
    columns = [_column(message, by_name.get(axis), "f") for axis in "xyz"]
    xyz_m = np.empty((message.width * message.height, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, and is dropped
        for i, column in enumerate(columns):
            if column is None:
                raise DecodeError(Refusal.CLOUD_FIELDS, "the cloud needs the fields x, y, z as float32 or float64")
            xyz_m[:, i] = column
        intensity = _column(message, by_name.get("intensity"), "fiu")
        ring = _column(message, next((by_name[n] for n in ("ring", "channel", "line") if n in by_name), None), "u")
        time = _column(message, next((by_name[n] for n in _TIME_FIELDS if n in by_name), None), "fiu")
        if ring is not None and ring.size and int(ring.max()) > 0xFFFF:
            raise DecodeError(Refusal.CLOUD_FIELDS, "a ring number exceeds 65535")
        return lidar_frame(
            stamp_ns,
            message.header.frame_id,
            xyz_m,
            None if intensity is None else intensity.astype(np.float32),
            None if ring is None else ring.astype(np.uint16),
            None if time is None else _time_offset_s(time, finite_rows(xyz_m), stamp_ns),
        )


def message_of(frame: LidarFrame) -> PointCloud2:
    """The message that `frame_of` reads back to an equal sweep; points packed without padding, time as
    Velodyne's."""
    given = [
        ("x", frame.xyz_m[:, 0], PointField.FLOAT32),
        ("y", frame.xyz_m[:, 1], PointField.FLOAT32),
        ("z", frame.xyz_m[:, 2], PointField.FLOAT32),
        ("intensity", frame.intensity, PointField.FLOAT32),
        ("ring", frame.ring, PointField.UINT16),
        ("time", frame.time_offset_s, PointField.FLOAT32),
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
    """All in Python integers, which do not overflow."""
    if message.is_bigendian:
        raise DecodeError(Refusal.CLOUD_BIG_ENDIAN, "big-endian clouds are not read")
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


def _column(message: PointCloud2, field: PointField | None, kinds: str) -> NDArray[Any] | None:
    """(N,) values of a field, or None when it is absent or not of these NumPy kinds."""
    if field is None or field.datatype not in _DTYPES or _DTYPES[field.datatype].kind not in kinds:
        return None
    dtype = _DTYPES[field.datatype]
    if field.offset + dtype.itemsize > message.point_step:
        raise DecodeError(Refusal.CLOUD_SHAPE, "a field lies outside its point")
    view: NDArray[Any] = np.ndarray(
        shape=(message.height, message.width),
        dtype=dtype,
        buffer=message.data,
        offset=field.offset,
        strides=(message.row_step, message.point_step),
    )
    return view.reshape(-1)


def _time_offset_s(time: NDArray[Any], keep: NDArray[np.bool_] | None, stamp_ns: int) -> NDArray[np.float32]:
    """(N,) float32 seconds after the stamp; judged by the points in `keep` only: the others carry
    anything."""
    if time.dtype.kind != "f":
        return (time * 1e-9).astype(np.float32)
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    since_stamp = (
        (time, _RELATIVE_S),
        ((time.astype(np.float64) - seconds) - nanoseconds * 1e-9, MAX_TIME_OFFSET_S),
        ((time.astype(np.float64) - stamp_ns) * 1e-9, MAX_TIME_OFFSET_S),
        (time, MAX_TIME_OFFSET_S),
    )
    for offset_s, limit_s in since_stamp:
        judged = offset_s if keep is None else offset_s[keep]
        judged = judged[np.isfinite(judged)]
        if judged.size == 0 or np.abs(judged).max() <= limit_s:
            return offset_s.astype(np.float32)
    raise DecodeError(Refusal.CLOUD_TIME, "the points' times are not near the stamp of their sweep in any known unit")
