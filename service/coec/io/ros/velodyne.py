"""Scans of Velodyne's packets (`velodyne_msgs/VelodyneScan`) as clouds, decoded by `velodyne-decoder`, the library of
the optional extra `velodyne`, which recognises the model and has the calibration of most; points are in the axes and
rings in the order of ROS's driver.
"""

from __future__ import annotations

import importlib.util

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.ros import messages

MAX_PACKETS = 4096
"""Most packets of a scan; a turn of the largest model at 5 Hz has some 2,500."""

_FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7), ("ring", 22, 2))
"""Name, offset and `PointField.datatype` of what is read of the library's points."""

WITHOUT_EXTRA = (
    "packets of Velodyne are decoded with the optional extra `velodyne`: pip install 'coec[velodyne]'; or convert them "
    "with velodyne_pointcloud's velodyne_transform_node, and take its topic of PointCloud2"
)


def cloud_of_scan(payload: bytes) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message in CDR, its points timed since its stamp.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid`; `message_type`: the optional extra is not installed.
    """
    count = messages.check_header(payload).number()
    if not 0 < count <= MAX_PACKETS:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, f"{count} packets; a scan has up to {MAX_PACKETS}")
    if importlib.util.find_spec("velodyne_decoder") is None:
        raise DecodeError(Refusal.MESSAGE_TYPE, WITHOUT_EXTRA)
    import velodyne_decoder as velodyne

    message = messages.deserialized_by_name(messages.VELODYNE_SCAN, payload)
    packets = [
        velodyne.VelodynePacket(each.stamp.sec + each.stamp.nanosec * 1e-9, each.data.tobytes())
        for each in message.packets
    ]
    try:
        stamps, points = velodyne.ScanDecoder(velodyne.Config()).decode(velodyne.PacketVector(packets), True)
    except (RuntimeError, ValueError, IndexError) as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, f"the packets of Velodyne are not read: {error}") from error
    # The library counts from the last packet, the message is stamped by its first or last one.
    stamp = message.header.stamp
    points["time"] += np.float32(stamps.host - (stamp.sec + stamp.nanosec * 1e-9))
    fields = [ros.sensor_msgs__msg__PointField(name, offset, kind, 1) for name, offset, kind in _FIELDS]
    step, data = points.dtype.itemsize, np.frombuffer(points.tobytes(), np.uint8)
    return ros.sensor_msgs__msg__PointCloud2(
        message.header, 1, len(points), fields, False, step, step * len(points), data, True
    )
