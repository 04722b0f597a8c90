"""Splits clouds of several LiDARs in one `PointCloud2`, by the field that tells the source of each point.

Most programs that join clouds write no such field. Autoware's `concatenate_data` puts the sources into another message
(`ConcatenatedPointCloudInfo`), and no field of its points (x, y, z, intensity, return_type, channel, azimuth,
elevation, distance, time_stamp) holds them. A `laser_id` or `channel` is the number of a beam, not of a LiDAR.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointField as PointField

from coec.adapters.frames.incoming import Refusal
from coec.errors import DecodeError

SOURCE_FIELDS: Final = ("lidar_id", "sensor_id", "source_id", "device_id", "source")
"""Names of integer fields in which joined clouds identify the LiDAR: `lidar_id`, `sensor_id` and `source` in published
projects, `device_id` in Kitware's SLAM (beside its `laser_id`, the beam)."""

_WIDTHS: Final = {
    PointField.INT8: "i1",
    PointField.UINT8: "u1",
    PointField.INT16: "i2",
    PointField.UINT16: "u2",
    PointField.INT32: "i4",
    PointField.UINT32: "u4",
}

MAX_LISTED: Final = 16
"""Most sources that a refusal lists. A vehicle has fewer LiDARs, but the field may hold other numbers, however many."""


def points_of_source(message: PointCloud2, source: int | None) -> PointCloud2:
    """The points of one LiDAR, in their order, as a cloud of one row; the message unchanged if it holds no others.

    Args:
        message: its data must be as long as its layout says.
        source: number of the requested LiDAR; None: the cloud must hold only one.

    Raises:
        DecodeError: `cloud_concatenated`: several sources but none requested, or no point of the requested one; lists
            the sources.
    """
    field = next((field for name in SOURCE_FIELDS for field in message.fields if field.name == name), None)
    values = None if field is None else _values(message, field)
    if field is None or values is None:
        if source is None:
            return message
        raise DecodeError(
            Refusal.CLOUD_CONCATENATED,
            f"source {source} is asked for, but no field of the points names one: {', '.join(SOURCE_FIELDS)} would",
        )
    selected = int(values[0, 0]) if source is None else source
    mine = values == selected
    if mine.all():
        return message
    if source is None or not mine.any():
        known = np.unique(values)
        listed = ", ".join(map(str, known[:MAX_LISTED].tolist())) + (", ..." if len(known) > MAX_LISTED else "")
        advice = "choose one" if source is None else f"none has {source}"
        raise DecodeError(
            Refusal.CLOUD_CONCATENATED, f"the cloud is concatenated: its {field.name} has {listed}; {advice}"
        )
    rows = _rows(message)[mine]
    return replace(
        message,
        height=1,
        width=len(rows),
        row_step=len(rows) * message.point_step,
        data=np.ascontiguousarray(rows).reshape(-1),
    )


def _values(message: PointCloud2, field: PointField) -> NDArray[np.integer] | None:
    """(height, width) numbers of a field; None if it holds no integers or lies outside of its point."""
    width = _WIDTHS.get(field.datatype)
    if width is None or field.offset + int(width[1]) > message.point_step:
        return None
    return np.ndarray(
        shape=(message.height, message.width),
        dtype=np.dtype(width).newbyteorder(">" if message.is_bigendian else "<"),
        buffer=message.data,
        offset=field.offset,
        strides=(message.row_step, message.point_step),
    )


def _rows(message: PointCloud2) -> NDArray[np.uint8]:
    """(height, width, point_step) bytes of the points."""
    return np.ndarray(
        shape=(message.height, message.width, message.point_step),
        dtype=np.uint8,
        buffer=message.data,
        strides=(message.row_step, message.point_step, 1),
    )
