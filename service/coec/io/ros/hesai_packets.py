"""Packets of Hesai's turning LiDARs as sweeps: Pandar40P, Pandar64, PandarQT, PandarXT-16, XT-32 and XTM, and those of
the platform of Pandar128 and OT128.

A message (`UdpFrame`, `PandarScan`, `NebulaPackets`) holds the packets of a turn. A packet has some blocks, each of an
azimuth and the returns of every laser; ranges come in units of 4 mm. Directions of the lasers come from the correction
file of the unit if there is one, else from the nominal table of its model, from which units differ by up to some
tenths of a degree. The axes are Hesai's: y to where azimuths begin, x to the right.

A point has the time of its block. Lasers of a block fire within 0.15 ms, and their azimuths are not corrected for it,
as Hesai's driver does not unless it is told to.

Source: Hesai's user manuals, "Point cloud data packet" and "Absolute time of point cloud data".
"""

from __future__ import annotations

import calendar
import functools
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal, lidar_frame
from coec.io.ros import messages

DESCRIBED: Final = b"Elevation,Azimuth"
"""What a correction file has in its first lines."""

WITHOUT_HEADER: Final = "hesai_lidar"
"""Frame of messages that name none: the default of hesai_ros_driver."""

MAX_PACKETS: Final = 8192
"""Most packets of a message; a turn of the largest model at 5 Hz has 2,700."""

MAX_PACKET_BYTES: Final = 2048
"""Most bytes of a packet; an Ethernet frame has 1500."""

CORRECTIONS: Final = (
    "give its correction file (CSV of elevations and azimuths, from the web page of the LiDAR): ?metadata=FILE of a "
    "recording, lidar.metadata of the service; or let hesai_ros_driver publish it (ros_send_correction_topic), and "
    "record that, too"
)


@dataclass(frozen=True, slots=True)
class Model:
    """How a model packs its returns, and how they are timed.

    Attributes:
        head: bytes before the blocks.
        block_head: bytes of a block before its returns; the last two are the azimuth.
        unit: bytes of a return.
        mode, date, time: places behind the blocks: return mode, date and microseconds.
        last_us: time of the last block after that of the packet, of a QT the first.
        step_us: time from block to block.
        elevations, azimuths: nominal directions of the lasers, degrees; empty: there are none.
    """

    name: str
    lasers: int
    blocks: int
    head: int
    block_head: int
    unit: int
    mode: int
    date: int
    time: int
    last_us: float
    step_us: float
    elevations: Sequence[float] = ()
    azimuths: Sequence[float] = ()

    @property
    def least(self) -> int:
        """Least bytes of a packet."""
        of_blocks = self.blocks * (self.block_head + self.lasers * self.unit)
        return self.head + of_blocks + max(self.mode + 1, self.date + 6, self.time + 4)

    def layout(self, size: int) -> np.dtype[Any]:
        """Layout of a packet of this size."""
        unit = np.dtype(
            {"names": ["range", "intensity"], "formats": ["<u2", "u1"], "offsets": [0, 2], "itemsize": self.unit}
        )
        block = np.dtype(
            {
                "names": ["azimuth", "units"],
                "formats": ["<u2", (unit, (self.lasers,))],
                "offsets": [self.block_head - 2, self.block_head],
                "itemsize": self.block_head + self.lasers * self.unit,
            }
        )
        behind = self.head + self.blocks * block.itemsize
        return np.dtype(
            {
                "names": ["blocks", "mode", "date", "time"],
                "formats": [(block, (self.blocks,)), "u1", ("u1", (6,)), "<u4"],
                "offsets": [self.head, *(behind + place for place in (self.mode, self.date, self.time))],
                "itemsize": size,
            }
        )


_STEP_40_US: Final = 55.56

_AZIMUTHS_40: Final = (
    *[-1.042] * 6, *(3.125, -5.208, -1.042) * 8, *[-1.042] * 10,
)  # fmt: skip
_ELEVATIONS_40: Final = (
    15.0, 11.0, 8.0, 5.0, 3.0, 2.0, *(-step / 3.0 for step in range(-5, 19)), *(-6.0 - step for step in range(1, 9)),
    -19.0, -25.0,
)  # fmt: skip
_AZIMUTHS_64: Final = (*[-1.042] * 6, *(1.042, 3.125, 5.208, -5.208, -3.125, -1.042) * 8, *[-1.042] * 10)
_ELEVATIONS_64: Final = (
    14.882, 11.032, 8.059, 5.057, 3.04, 2.028, 1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337,
    0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.86, -2.028, -2.198,
    -2.365, -2.536, -2.7, -2.873, -3.04, -3.21, -3.375, -3.548, -3.712, -3.884, -4.05, -4.221, -4.385, -4.558, -4.72,
    -4.892, -5.057, -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.06, -9.885, -11.032, -12.006,
    -12.974, -13.93, -18.889, -24.897,
)  # fmt: skip
_ELEVATIONS_QT: Final = (
    -52.121, -49.785, -47.577, -45.477, -43.465, -41.528, -39.653, -37.831, -36.055, -34.32, -32.619, -30.95, -29.308,
    -27.69, -26.094, -24.517, -22.964, -21.42, -19.889, -18.372, -16.865, -15.368, -13.88, -12.399, -10.925, -9.457,
    -7.994, -6.535, -5.079, -3.626, -2.175, -0.725, 0.725, 2.175, 3.626, 5.079, 6.534, 7.993, 9.456, 10.923, 12.397,
    13.877, 15.365, 16.861, 18.368, 19.885, 21.415, 22.959, 24.524, 26.101, 27.697, 29.315, 30.957, 32.627, 34.328,
    36.064, 37.84, 39.662, 41.537, 43.475, 45.487, 47.587, 49.795, 52.133,
)  # fmt: skip
_AZIMUTHS_QT: Final = (
    8.736, 8.314, 7.964, 7.669, 7.417, 7.198, 7.007, 6.838, 6.688, 6.554, 6.434, 6.326, 6.228, 6.14, 6.059, 5.987,
    -5.27, -5.216, -5.167, -5.123, -5.083, -5.047, -5.016, -4.988, -4.963, -4.942, -4.924, -4.91, -4.898, -4.889,
    -4.884, -4.881, 5.493, 5.496, 5.502, 5.512, 5.525, 5.541, 5.561, 5.584, 5.611, 5.642, 5.676, 5.716, 5.759, 5.808,
    5.862, 5.921, -5.33, -5.396, -5.469, -5.55, -5.64, -5.74, -5.85, -5.974, -6.113, -6.269, -6.447, -6.651, -6.887,
    -7.163, -7.493, -7.892,
)  # fmt: skip

_PANDAR_40P: Final = Model("Pandar40P", 40, 10, 0, 4, 3, 14, 16, 10, -57.6, _STEP_40_US, _ELEVATIONS_40, _AZIMUTHS_40)
_PANDAR_64: Final = Model("Pandar64", 64, 6, 8, 2, 3, 14, 16, 10, -71.6, _STEP_40_US, _ELEVATIONS_64, _AZIMUTHS_64)
_PANDAR_QT: Final = Model("PandarQT", 64, 4, 12, 2, 4, 16, 18, 12, 105.1, 166.7, _ELEVATIONS_QT, _AZIMUTHS_QT)


def _xt(name: str, lasers: int, blocks: int, top: float, step: float) -> Model:
    elevations = tuple(top - step * laser for laser in range(lasers))
    return Model(name, lasers, blocks, 12, 2, 4, 10, 13, 19, 29.0, 50.0, elevations, (0.0,) * lasers)


_WITH_HEADER: Final = {
    (3, 1, 64, 4): _PANDAR_QT,
    (6, 1, 16, 8): _xt("PandarXT-16", 16, 8, 15.0, 2.0),
    (6, 1, 32, 8): _xt("PandarXT-32", 32, 8, 15.0, 1.0),
    (6, 1, 32, 6): _xt("PandarXTM", 32, 6, 19.5, 1.3),
}
"""By version of the protocol, lasers and blocks."""

PLATFORM_128: Final = "Pandar128"
"""Models of the protocol 1.4, with up to 128 lasers: Pandar128, OT128, Pandar40E3X, 64E3X, 90E3X. No nominal table."""

MODELS: Final = (_PANDAR_40P, _PANDAR_64, *_WITH_HEADER.values())
"""The models whose directions are known."""

UNREAD: Final = {
    (1, 8): "JT16",
    (2, 4): "ET25",
    (2, 5): "ET25",
    (2, 6): "ET25",
    (2, 7): "ET30",
    (3, 2): "QT128",
    (4, 1): "AT128",
    (4, 3): "AT128",
    (4, 7): "ATX",
    (7, 2): "FT120",
}
"""Models that are not read, by version of the protocol."""

_MODES: Final = {0x39: 2, 0x3A: 2, 0x3B: 2, 0x3C: 2, 0x3D: 3}
"""Returns of a shot, each a block, by the return mode; one for any other."""


def _model_of(packet: bytes | memoryview) -> Model:
    """The model that sent a packet, by its size and beginning.

    Raises:
        DecodeError: `message_malformed`: none; `message_type`: one that is not read.
    """
    size, begin = len(packet), bytes(packet[:12])
    if size in (1262, 1266) and begin.startswith(b"\xff\xee"):
        return _PANDAR_40P
    if size in (1194, 1198) and begin.startswith(b"\xee\xff\x40\x06"):
        return _PANDAR_64
    model = _by_header(begin) if begin.startswith(b"\xee\xff") and size >= 500 else None
    if model is None or size < model.least:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "no packets of points of a Hesai")
    return model


@functools.lru_cache(maxsize=256)
def _by_header(begin: bytes) -> Model:
    lasers, blocks, flags = begin[6], begin[7], begin[11]
    model = _WITH_HEADER.get((begin[2], begin[3], lasers, blocks))
    if model is not None:
        return model
    match begin[2], begin[3]:
        case (1, 4) if 0 < lasers <= 128 and 0 < blocks <= 4:
            unit, tail = (4 if flags & 0x10 else 3), (21 if flags & 0x04 else 4)
            places = (tail + 12, tail + 15, tail + 21)
            return Model(PLATFORM_128, lasers, blocks, 12, 2, unit, *places, 27.0, _STEP_40_US)
        case version:
            name = UNREAD.get(version, f"of the protocol {version[0]}.{version[1]}")
            text = (
                f"packets of a Hesai {name} are not read: let hesai_ros_driver or nebula_ros convert them, and take "
                "the topic of PointCloud2"
            )
            raise DecodeError(Refusal.MESSAGE_TYPE, text)


# --- messages ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Form:
    """What a packet of a message has beside its data: a stamp before it, its size behind it; `fixed`: it always has so
    many bytes."""

    stamp: bool
    size: bool
    fixed: int = 0


_FORMS: Final = (_Form(True, True), _Form(False, True), _Form(True, False), _Form(True, True, 1500))
"""Of the versions of the drivers' messages; the definition of a message is not at hand."""


def _packets(data: bytes, at: int, alignment: int) -> list[memoryview]:
    """The packets in a message whose list begins at a place. With alignment, it counts from the fourth byte."""
    (count,) = struct.unpack_from("<I", data, at)
    if not 0 < count <= MAX_PACKETS:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, f"{count} packets; a message has up to {MAX_PACKETS}")
    for form in _FORMS:
        packets = _in_form(memoryview(data), at + 4, count, form, alignment)
        if packets is not None:
            return packets
    raise DecodeError(Refusal.MESSAGE_MALFORMED, "the packets of a Hesai are cut off, or in an unknown form")


def _in_form(data: memoryview, at: int, count: int, form: _Form, alignment: int) -> list[memoryview] | None:
    packets = []
    for _ in range(count):
        at += -at % alignment + 8 * form.stamp
        size = form.fixed
        if not size:
            if at + 4 > len(data):
                return None
            size = int.from_bytes(data[at : at + 4], "little")
            at += 4
        packet, at = data[at : at + size], at + size
        if form.size:
            at += -at % alignment
            own = int.from_bytes(data[at : at + 4], "little")
            if own > size:
                return None
            packet, at = packet[:own], at + 4
        if at > len(data):
            return None
        packets.append(packet)
    return packets if len(data) - at < max(alignment, 1) else None


def _read(payload: bytes) -> tuple[str, list[memoryview]]:
    """Frame and packets of a message in CDR. Early versions of `UdpFrame` have no header."""
    if payload[1:2] != b"\1":
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "not a message in little-endian CDR")
    try:
        begin = messages.check_header(payload).place()
        return messages.header_frame_id(payload), _packets(payload, begin, 4)
    except (DecodeError, struct.error) as error:
        try:
            return WITHOUT_HEADER, _packets(payload, 4, 4)
        except (DecodeError, struct.error):
            what = "the packets of a Hesai are cut off, too many, or in an unknown form"
            raise DecodeError(Refusal.MESSAGE_MALFORMED, what) from error


def cdr_of_ros_1(data: bytes) -> bytes:
    """A message of ROS 1, whose header begins with a sequence number, as `NebulaPackets` in CDR.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid`.
    """
    try:
        seconds, nanoseconds, length = struct.unpack_from("<III", data, 4)
        frame = data[16 : 16 + length].decode(errors="replace")
        packets = _packets(data, 16 + length, 1)
    except struct.error as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head") from error
    stamp = ros.builtin_interfaces__msg__Time(min(seconds, 2**31 - 1), nanoseconds)
    of_packet = messages.message_class("nebula_msgs/msg/NebulaPacket")
    packed = [of_packet(stamp, np.frombuffer(packet, np.uint8)) for packet in packets]
    header = ros.std_msgs__msg__Header(stamp, messages.frame_id(frame))
    message = messages.message_class(messages.NEBULA_PACKETS)(header, packed)
    return messages.serialized(message, messages.NEBULA_PACKETS)


def glimpse(payload: bytes) -> bytes:
    """What the index keeps of a message in CDR: the frame, and the first and the last packet.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid`.
    """
    frame, packets = _read(payload)
    first, last = (bytes(packets[end][:MAX_PACKET_BYTES]) for end in (0, -1))
    name = frame.encode()
    return struct.pack("<HH", len(name), len(first)) + name + first + last


def _glimpsed(data: bytes) -> tuple[str, bytes, bytes]:
    name, first = struct.unpack_from("<HH", data)
    begin = 4 + name
    return data[4:begin].decode(), data[begin : begin + first], data[begin + first :]


# --- sweeps -----------------------------------------------------------------------------------------------------------


def sensor_of(glimpses: Sequence[bytes], correction: bytes | None) -> HesaiSensor:
    """The sensor that sent some messages; `correction`: its correction file.

    Raises:
        DecodeError: `message_malformed`, `message_type`.
    """
    frame, first, _ = _glimpsed(glimpses[0])
    model = _model_of(first)
    if correction is not None:
        return HesaiSensor(frame, model, *_corrections(correction, model), is_nominal=False)
    if not model.elevations:
        text = f"packets of a Hesai {model.name} need the directions of its lasers: {CORRECTIONS}"
        raise DecodeError(Refusal.MESSAGE_TYPE, text)
    return HesaiSensor(frame, model, np.radians(model.elevations), np.radians(model.azimuths), is_nominal=True)


def _corrections(text: bytes, model: Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(lasers,) elevations and azimuths, radians, from lines `laser,elevation,azimuth`."""
    angles_deg = np.full((model.lasers, 2), np.nan)
    for line in text.decode(errors="replace").splitlines():
        try:
            laser, elevation, azimuth, *_ = map(float, line.split(","))
            angles_deg[int(laser) - 1 if 1 <= laser <= model.lasers else model.lasers] = elevation, azimuth
        except (ValueError, IndexError, OverflowError):
            continue
    if not (np.abs(angles_deg) <= 90.0).all():
        known = int(np.isfinite(angles_deg).all(axis=1).sum())
        text_ = f"the correction file has {known} of the {model.lasers} lasers of the {model.name}: is it of another?"
        raise DecodeError(Refusal.MESSAGE_MALFORMED, text_)
    elevations, azimuths = np.radians(angles_deg).T
    return elevations, azimuths


@dataclass(frozen=True, slots=True, eq=False)
class HesaiSensor:
    """A sensor.

    Attributes:
        elevation_rad, azimuth_rad: (lasers,) directions; azimuths count clockwise.
        is_nominal: whether these are those of the model.
        pose: none, because the driver's messages name the frame of the points; see `PacketSensor`.
    """

    frame_id: str
    model: Model
    elevation_rad: NDArray[np.float64]
    azimuth_rad: NDArray[np.float64]
    is_nominal: bool
    pose: tuple[str, Matrix4] | None = None

    @property
    def name(self) -> str:
        """See `PacketSensor`."""
        return f"Hesai {self.model.name}"

    @property
    def notes(self) -> tuple[Recognition, ...]:
        """See `PacketSensor`."""
        if not self.is_nominal:
            return ()
        text = (
            f"The packets of the LiDAR are read with the nominal directions of the lasers of a {self.model.name}, from "
            f"which a unit differs by some tenths of a degree, and so may the result: {CORRECTIONS}."
        )
        return (Recognition("nominal_angles", text, "warn"),)

    def heads(self, glimpses: Sequence[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `PacketSensor`: each message is a sweep."""
        times_ns, numbers = np.zeros((len(glimpses), 2), np.int64), np.arange(len(glimpses))
        for index, one in enumerate(glimpses):
            try:
                _, *ends = _glimpsed(one)
                packets = [np.frombuffer(end, self.model.layout(len(end)))[:1] for end in ends if self._is_own(end)]
            except DecodeError:
                packets = []
            if len(packets) == 2:
                times_ns[index] = [
                    int(self._times_ns(packet)[0, at]) for packet, at in zip(packets, (0, -1), strict=True)
                ]
            else:
                numbers[index] = -1
        return times_ns, numbers

    def sweep(self, payloads: Sequence[bytes], at_ns: int, stamp_ns: int) -> LidarFrame:
        """See `PacketSensor`; points are ordered by packet, block and laser. Of several returns of a shot, equal ones
        count once.

        Raises:
            DecodeError: `message_malformed`, `frame_id_invalid`, `cloud_empty`, `cloud_time`.
        """
        read = (packet for payload in payloads for packet in _read(payload)[1])
        own = [packet for packet in read if len(packet) <= MAX_PACKET_BYTES and self._is_own(packet)]
        if not own:
            raise DecodeError(Refusal.CLOUD_EMPTY, f"the message has no packets of a {self.model.name}")
        sizes = Counter(len(packet) for packet in own)
        layout = self.model.layout(sizes.most_common(1)[0][0])
        packets = np.frombuffer(b"".join(one for one in own if len(one) == layout.itemsize), layout)
        blocks = packets["blocks"]
        ranges = blocks["units"]["range"].astype(np.int32)
        returns = _returns(packets)
        again = np.arange(self.model.blocks) % returns[:, None] > 0
        same = np.zeros(ranges.shape, bool)
        same[:, 1:] = (ranges[:, 1:] == ranges[:, :-1]) & again[:, 1:, None]
        packet, block, laser = np.nonzero((ranges > 0) & ~same)
        unit_m = 1e-3 * (own[0][9] if self.model.head == 12 else 4)
        range_m = ranges[packet, block, laser] * unit_m
        azimuth_rad = np.radians(0.01 * blocks["azimuth"][packet, block]) + self.azimuth_rad[laser]
        level_m = range_m * np.cos(self.elevation_rad)[laser]
        xyz_m = np.empty((len(laser), 3), np.float32)
        xyz_m[:, 0], xyz_m[:, 1] = level_m * np.sin(azimuth_rad), level_m * np.cos(azimuth_rad)
        xyz_m[:, 2] = range_m * np.sin(self.elevation_rad)[laser]
        after_s = ((self._times_ns(packets) - at_ns) * 1e-9).astype(np.float32)[packet, block]
        intensity = blocks["units"]["intensity"][packet, block, laser].astype(np.float32)
        by = f"block times of {self.model.name}"
        return lidar_frame(stamp_ns, self.frame_id, xyz_m, intensity, laser.astype(np.uint16), after_s, timed_by=by)

    def _is_own(self, packet: bytes | memoryview) -> bool:
        try:
            return _model_of(packet) == self.model
        except DecodeError:
            return False

    def _times_ns(self, packets: NDArray[Any]) -> NDArray[np.int64]:
        """(packets, blocks) time of each block by the sensor's clock."""
        seconds = np.array([_seconds(*date) for date in packets["date"].tolist()], np.int64)
        model, block = self.model, np.arange(self.model.blocks)
        returns = _returns(packets)[:, None]
        steps = block // returns if model is _PANDAR_QT else -((model.blocks - 1 - block) // returns)
        after_us = packets["time"].astype(np.int64)[:, None] + model.last_us + model.step_us * steps
        times_ns: NDArray[np.int64] = seconds[:, None] * 10**9 + np.rint(1e3 * after_us).astype(np.int64)
        return times_ns


def _returns(packets: NDArray[Any]) -> NDArray[np.int64]:
    """(packets,) returns of a shot."""
    by_mode = np.array([_MODES.get(mode, 1) for mode in range(256)])
    returns: NDArray[np.int64] = by_mode[packets["mode"]]
    return returns


@functools.lru_cache
def _seconds(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int:
    """Seconds since 1970 of a date whose year counts from 1900 or 2000; or big-endian in the last four bytes."""
    if year == month == 0:
        return int.from_bytes(bytes((day, hour, minute, second)), "big")
    if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second <= 60):
        return 0
    return calendar.timegm((year + (1900 if year >= 100 else 2000), month, day, hour, minute, second))
