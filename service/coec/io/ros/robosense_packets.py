"""Packets of RoboSense's RS-16, RS-32 and Helios (32 lasers) as sweeps.

A message (`RslidarPacket`) holds one packet: of points (MSOP), with 12 blocks of an azimuth and 32 returns, or of
information (DIFOP), with the directions of the lasers, and in which mode the LiDAR is. RS-16 and RS-32 do not tell
themselves apart for sure in packets of points; the directions do. Ranges come in 5 mm, of a Helios in 2.5 mm. Lasers
of a block fire one after the other; their azimuths and times follow from that.

Source: the user manuals of these LiDARs, chapters "MSOP" and "DIFOP"; x is forward where azimuths begin, y left.
"""

from __future__ import annotations

import calendar
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal, lidar_frame
from coec.io.ros import messages

DESCRIBED: Final = b"\xa5\xff\x00\x5a\x11\x11\x55\x55"
"""What a DIFOP packet begins with."""

PACKET_BYTES: Final = 1248
"""Of both kinds."""

_MSOP, _MSOP_HELIOS = b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0", b"\x55\xaa\x05\x5a"
_BLOCKS, _CHANNELS, _HEAD = 12, 32, 42
_RETURN_MODE_AT, _ELEVATIONS_AT, _ELEVATIONS_16_AT = 300, 468, 1165
_BLOCK_ID: Final = 0xFFEE

_NONE: Final = (
    "there are packets of a RoboSense, but no DIFOP packet with the directions of its lasers: record or publish those, "
    "too (rslidar_sdk sends both on one topic), or take the topic of PointCloud2"
)
_OTHER: Final = (
    "packets of a RoboSense that is no RS-16, RS-32 or Helios of 32 lasers are not read: let rslidar_sdk convert them, "
    "`msg_source: 2` in its config.yaml, and take the topic of PointCloud2"
)


@dataclass(frozen=True, slots=True)
class Model:
    """A model.

    Attributes:
        range_m: unit of ranges.
        lens_m: distance of the lens from the axis.
        firing_us: time from one firing of all lasers to the next; a block has one, of an RS-16 two.
        lasers_us: (lasers,) when each fires after the first one.
    """

    name: str
    range_m: float
    lens_m: float
    firing_us: float
    lasers_us: tuple[float, ...]


_RS_16: Final = Model("RS-16", 0.005, 0.03825, 55.5, tuple(2.8 * laser for laser in range(16)))
_RS_32: Final = Model(
    "RS-32",
    0.005,
    0.03997,
    55.52,
    (*(2.88 * laser for laser in range(15)), 44.64, *(1.44 + 2.88 * laser for laser in range(15)), 46.08),
)
_HELIOS: Final = Model("Helios", 0.0025, 0.03498, 55.56, tuple(1.73 * laser for laser in range(32)))
MODELS: Final = (_RS_16, _RS_32, _HELIOS)

_PACKET: Final = np.dtype(
    {
        "names": ["time", "blocks"],
        "formats": [
            ("u1", (10,)),
            (
                np.dtype(
                    [
                        ("id", ">u2"),
                        ("azimuth", ">u2"),
                        ("units", np.dtype([("range", ">u2"), ("intensity", "u1")]), (_CHANNELS,)),
                    ]
                ),
                (_BLOCKS,),
            ),
        ],
        "offsets": [20, _HEAD],
        "itemsize": PACKET_BYTES,
    }
)


def _read(payload: bytes) -> tuple[bool, memoryview]:
    """Whether a sweep begins with a message in CDR, as its driver says, and the packet in it."""
    head = messages.check_header(payload)
    head.byte()  # is_difop
    is_begin = head.byte() != 0
    size, begin = head.number(), head.place()
    if size > len(payload) - begin:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the packet is cut off")
    return is_begin, memoryview(payload)[begin : begin + size]


def glimpse(payload: bytes) -> bytes:
    """What the index keeps of a message in CDR: the length of the frame's name, whether a sweep begins, the name; of a
    packet of points its head and first azimuth, of one of information all.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid`.
    """
    is_begin, view = _read(payload)
    packet, frame = bytes(view), messages.header_frame_id(payload).encode()
    known = len(packet) == PACKET_BYTES and (packet.startswith(DESCRIBED) or _is_of_points(packet))
    retained = b"" if not known else packet if packet.startswith(DESCRIBED) else packet[: _HEAD + 4]
    return len(frame).to_bytes(2, "little") + bytes([is_begin]) + frame + retained


def _is_of_points(packet: bytes | memoryview) -> bool:
    return bytes(packet[:8]) == _MSOP or bytes(packet[:4]) == _MSOP_HELIOS


def _seen(one: bytes) -> bytes:
    return one[3 + int.from_bytes(one[:2], "little") :]


def sensor_of(glimpses: Sequence[bytes], difop: bytes | None) -> RobosenseSensor:
    """The sensor that sent some messages; `difop`: a packet with the directions of its lasers, if not among them.

    Raises:
        DecodeError: `message_type`.
    """
    seen = [_seen(one) for one in glimpses]
    given = [] if difop is None else [difop[difop.find(DESCRIBED) :][:PACKET_BYTES]]
    described = [one for one in (*given, *seen) if one.startswith(DESCRIBED) and len(one) == PACKET_BYTES]
    of_points = next((one for one in seen if _is_of_points(one)), None)
    if of_points is None:
        raise DecodeError(Refusal.MESSAGE_TYPE, _OTHER)
    candidates = (_HELIOS,) if of_points.startswith(_MSOP_HELIOS) else (_RS_16, _RS_32)
    length = int.from_bytes(glimpses[0][:2], "little")
    frame = glimpses[0][3 : 3 + length].decode(errors="replace")
    for packet in described:
        fits = [(model, *angles) for model in candidates if (angles := _DIRECTIONS[model.name](packet)) is not None]
        if len(fits) == 1:
            return RobosenseSensor(frame, *fits[0], is_dual=packet[_RETURN_MODE_AT] == 0)
    # A sensor that has just started sends empty directions.
    filled = [one for one in described if any(one[_ELEVATIONS_AT : _ELEVATIONS_AT + 96].strip(b"\0\xff"))]
    raise DecodeError(Refusal.MESSAGE_TYPE, _OTHER if filled else _NONE)


Directions = tuple[NDArray[np.float64], NDArray[np.float64]]


def _of_16(packet: bytes) -> Directions | None:
    """Elevations in 0.0001°, without a sign: the lower eight lasers come first. -15° to -1°, and 15° to 1°."""
    raw = np.frombuffer(packet, "u1", 48, _ELEVATIONS_16_AT).reshape(16, 3).astype(np.int64)
    size_deg = 1e-4 * (raw @ [65536, 256, 1])
    if np.abs(size_deg - np.tile(np.arange(15.0, 0.0, -2.0), 2)).max() > 1.5:
        return None
    return np.radians(size_deg * np.repeat([-1.0, 1.0], 8)), np.zeros(16)


def _of_32(
    unit_deg: float, lowest: tuple[float, float], highest: tuple[float, float]
) -> Callable[[bytes], Directions | None]:
    """Elevations and azimuths with a sign, which reach from about a lowest to about a highest elevation."""

    def read(packet: bytes) -> Directions | None:
        raw = np.frombuffer(packet, np.dtype([("sign", "u1"), ("value", ">u2")]), 64, _ELEVATIONS_AT)
        angles_deg = unit_deg * np.where(raw["sign"] == 0, 1.0, -1.0) * raw["value"]
        elevations, azimuths = angles_deg.reshape(2, 32)
        reaches = lowest[0] <= elevations.min() <= lowest[1] and highest[0] <= elevations.max() <= highest[1]
        if (raw["sign"] > 1).any() or not reaches or np.abs(azimuths).max() > 20.0 or len(set(elevations)) < 32:
            return None
        return np.radians(elevations), np.radians(azimuths)

    return read


_DIRECTIONS: Final = {
    "RS-16": _of_16,
    "RS-32": _of_32(0.001, (-27.0, -23.0), (13.0, 17.0)),
    "Helios": _of_32(0.01, (-60.0, -10.0), (5.0, 20.0)),
}
"""By the name of the model; None: a packet does not have the directions of such a model."""


@dataclass(frozen=True, slots=True, eq=False)
class RobosenseSensor:
    """A sensor.

    Attributes:
        elevation_rad, azimuth_rad: (lasers,) directions; azimuths count clockwise.
        is_dual: whether each firing has two returns.
        pose, notes: none; see `PacketSensor`.
    """

    frame_id: str
    model: Model
    elevation_rad: NDArray[np.float64]
    azimuth_rad: NDArray[np.float64]
    is_dual: bool
    pose: tuple[str, Matrix4] | None = None
    notes: tuple[Recognition, ...] = ()

    @property
    def name(self) -> str:
        """See `PacketSensor`."""
        return f"RoboSense {self.model.name}"

    def heads(self, glimpses: Sequence[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `PacketSensor`: a sweep begins where the driver says so, else where azimuths do."""
        seen = [_seen(one) for one in glimpses]
        times_ns, numbers = np.zeros((len(seen), 2), np.int64), np.full(len(seen), -1, np.int64)
        numbers[[one.startswith(DESCRIBED) for one in seen]] = -2
        own = [index for index, one in enumerate(seen) if _is_of_points(one)]
        begins = np.array([glimpses[index][2] == 1 for index in own])
        if not begins.any():
            azimuths = np.array([int.from_bytes(seen[index][_HEAD + 2 : _HEAD + 4], "big") for index in own])
            begins = np.diff(azimuths, prepend=azimuths[:1]) < -18_000
        numbers[own] = np.cumsum(begins)
        fields = np.frombuffer(b"".join(seen[index][20:30] for index in own), "u1").reshape(-1, 10)
        times_ns[own] = self._times_ns(fields)[:, None] + np.rint(1e3 * self._blocks_us()[[0, -1]]).astype(np.int64)
        return times_ns, numbers

    def sweep(self, payloads: Sequence[bytes], at_ns: int, stamp_ns: int) -> LidarFrame:
        """See `PacketSensor`; of two returns, equal ones count once.

        Raises:
            DecodeError: `message_malformed`, `frame_id_invalid`, `cloud_empty`, `cloud_time`.
        """
        read = (_read(payload)[1] for payload in payloads)
        own = [packet for packet in read if len(packet) == PACKET_BYTES and _is_of_points(packet)]
        packets = np.frombuffer(b"".join(own), _PACKET)
        blocks, model, lasers = packets["blocks"], self.model, len(self.elevation_rad)
        ranges = blocks["units"]["range"].astype(np.int32)
        again = np.zeros(ranges.shape, bool)
        if self.is_dual and lasers == 16:
            again[..., 16:] = ranges[..., 16:] == ranges[..., :16]
        elif self.is_dual:
            again[:, 1::2] = ranges[:, 1::2] == ranges[:, ::2]
        packet, block, channel = np.nonzero((ranges > 0) & ~again & (blocks["id"] == _BLOCK_ID)[..., None])
        laser, firing = channel % lasers, 0 if self.is_dual else channel // lasers
        within_us = np.asarray(model.lasers_us)[laser] + model.firing_us * firing
        lens_rad = np.radians(0.01 * blocks["azimuth"])[packet, block] + self._speeds(blocks)[packet, block] * within_us
        azimuth_rad = lens_rad + self.azimuth_rad[laser]
        range_m = ranges[packet, block, channel] * model.range_m
        level_m = range_m * np.cos(self.elevation_rad)[laser]
        xyz_m = np.empty((len(laser), 3), np.float32)
        xyz_m[:, 0] = level_m * np.cos(azimuth_rad) + model.lens_m * np.cos(lens_rad)
        xyz_m[:, 1] = -level_m * np.sin(azimuth_rad) - model.lens_m * np.sin(lens_rad)
        xyz_m[:, 2] = range_m * np.sin(self.elevation_rad)[laser]
        after_s = 1e-9 * (self._times_ns(packets["time"]) - at_ns)[packet] + 1e-6 * (
            self._blocks_us()[block] + within_us
        )
        ring = np.argsort(np.argsort(self.elevation_rad))[laser].astype(np.uint16)
        intensity = blocks["units"]["intensity"][packet, block, channel].astype(np.float32)
        by = f"block times of {model.name}"
        return lidar_frame(stamp_ns, self.frame_id, xyz_m, intensity, ring, after_s.astype(np.float32), timed_by=by)

    def _block_us(self) -> float:
        """Time from block to block of different firings."""
        return self.model.firing_us * (2.0 if len(self.elevation_rad) == 16 and not self.is_dual else 1.0)

    def _blocks_us(self) -> NDArray[np.float64]:
        """(blocks,) time of each block after that of its packet."""
        pairs = self.is_dual and len(self.elevation_rad) == 32
        return np.asarray(self._block_us() * (np.arange(_BLOCKS) // (2 if pairs else 1)), np.float64)

    def _speeds(self, blocks: NDArray[Any]) -> NDArray[np.float64]:
        """(packets, blocks) turn rate, rad/µs, from the azimuths of the next block; of the last one from the one
        before. Between blocks with a gap, where the LiDAR does not look, that of the packet's other blocks."""
        pairs = 2 if self.is_dual and len(self.elevation_rad) == 32 else 1
        steps = np.diff(blocks["azimuth"].astype(np.int32)[:, ::pairs], axis=1) % 36_000
        usual = np.median(steps, axis=1, keepdims=True)
        steps = np.where(steps > 2 * usual, usual, steps)
        steps = np.repeat(np.concatenate([steps, steps[:, -1:]], axis=1), pairs, axis=1)
        speeds: NDArray[np.float64] = np.deg2rad(steps * (0.01 / self._block_us()), dtype=np.float64)
        return speeds

    def _times_ns(self, fields: NDArray[np.uint8]) -> NDArray[np.int64]:
        """(packets,) time of each packet: a date with milliseconds and microseconds, of a Helios seconds since 1970."""
        wide = fields.astype(np.int64)
        if self.model is _HELIOS:
            weights = 256 ** np.arange(5, -1, -1)
            micros = wide[:, 6:] @ 256 ** np.arange(3, -1, -1)
            return np.minimum(wide[:, :6] @ weights, 2**32) * 10**9 + micros * 1000  # type: ignore[no-any-return]
        seconds = np.array([_seconds(*date) for date in wide[:, :6].tolist()], np.int64)
        parts = wide[:, 6::2] * 256 + wide[:, 7::2]
        return seconds * 10**9 + parts[:, 0] * 10**6 + parts[:, 1] * 1000  # type: ignore[no-any-return]


@functools.lru_cache
def _seconds(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int:
    if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second <= 60):
        return 0
    return calendar.timegm((2000 + year, month, day, hour, minute, second))
