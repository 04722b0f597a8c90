"""Packets of LiDARs, packed by hand after the manuals of their makers; and drives whose sweeps are in such packets."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame
from coec.io.ros import messages
from support.ros import Packer

Entry = tuple[int, str, str, bytes]
"""Time of receipt, topic, type, message."""

OUSTER = "ouster_sensor_msgs/msg/PacketMsg"

PIXELS = {
    "LEGACY": (12, 6, 1),
    "RNG19_RFL8_SIG16_NIR16": (12, 6, 1),
    "RNG19_RFL8_SIG16_NIR16_DUAL": (16, 8, 1),
    "RNG15_RFL8_NIR8": (4, 2, 8),
}
"""By profile: bytes of a pixel, place of its intensity, unit of its range in mm."""


@dataclass
class Ouster:
    """A sensor of 64 × 1024 of the first generation in small; all angles in degrees, lengths in millimetres."""

    profile: str = "RNG19_RFL8_SIG16_NIR16"
    columns: int = 64
    altitudes: list[float] = field(default_factory=lambda: [16.611, 4.482, -7.646, -16.611])
    azimuths: list[float] = field(default_factory=lambda: [3.164, 1.055, -1.055, -3.164])
    beam_origin: tuple[float, float] = (15.806, 7.5)
    in_packet: int = 16

    def metadata(self, **changed: Any) -> bytes:
        """As a sensor of firmware 2.3 and later writes it."""
        x, z = self.beam_origin
        beams = {
            "beam_altitude_angles": self.altitudes,
            "beam_azimuth_angles": self.azimuths,
            "beam_to_lidar_transform": [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0],
            "lidar_origin_to_beam_origin_mm": x,
        }
        layout = {
            "columns_per_frame": self.columns,
            "columns_per_packet": self.in_packet,
            "pixels_per_column": len(self.altitudes),
            "udp_profile_lidar": self.profile,
        }
        transform = [-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 36.18, 0.0, 0.0, 0.0, 1.0]
        document = {
            "beam_intrinsics": beams,
            "lidar_data_format": layout,
            "lidar_intrinsics": {"lidar_to_sensor_transform": transform},
            "config_params": {"timestamp_mode": "TIME_FROM_PTP_1588"},
        }
        return json.dumps({**document, **changed}).encode()

    def packets(
        self, ranges_mm: NDArray[Any], intensity: NDArray[Any], begin_ns: int, frame: int, step_ns: int
    ) -> list[bytes]:
        """Packets of a turn of (columns, beams) ranges."""
        size, intensity_at, unit = PIXELS[self.profile]
        legacy = self.profile == "LEGACY"
        packets = []
        for first in range(0, self.columns, self.in_packet):
            packet = b"" if legacy else struct.pack("<HH28x", 1, frame)
            for number in range(first, first + self.in_packet):
                head = struct.pack("<QH", begin_ns + number * step_ns, number)
                packet += head + (struct.pack("<HI", frame, 1000) if legacy else struct.pack("<H", 1))
                pixels = np.zeros((len(self.altitudes), size), np.uint8)
                width = 2 if unit == 8 else 3
                in_units = np.asarray(ranges_mm[number], "<u4") // unit
                pixels[:, :width] = in_units.view(np.uint8).reshape(-1, 4)[:, :width]
                wide = "u1" if unit == 8 else "<u2"
                signal = np.asarray(intensity[number]).astype(wide).view(np.uint8).reshape(len(self.altitudes), -1)
                pixels[:, intensity_at : intensity_at + signal.shape[1]] = signal
                packet += pixels.tobytes() + (b"\xff\xff\xff\xff" if legacy else b"")
            packets.append(packet + (b"" if legacy else bytes(32)))
        return packets

    def points(self, ranges_mm: NDArray[Any]) -> list[tuple[float, float, float]]:
        """In the LiDAR's frame, in metres, one after the other, after "Lidar range to XYZ" of Ouster's manual."""
        x_mm, z_mm = self.beam_origin
        away = np.hypot(x_mm, z_mm)
        points = []
        for number in range(self.columns):
            encoder = 2.0 * np.pi * (1.0 - number / self.columns)
            for beam, (altitude, azimuth) in enumerate(zip(self.altitudes, self.azimuths, strict=True)):
                along = float(ranges_mm[number, beam]) - away
                if ranges_mm[number, beam]:
                    phi, theta = np.radians(altitude), encoder - np.radians(azimuth)
                    x = along * np.cos(theta) * np.cos(phi) + x_mm * np.cos(encoder)
                    y = along * np.sin(theta) * np.cos(phi) + x_mm * np.sin(encoder)
                    points.append((1e-3 * x, 1e-3 * y, 1e-3 * (along * np.sin(phi) + z_mm)))
        return points


def ouster_message(packet: bytes) -> bytes:
    return Packer().octets(packet).done()


def string_message(text: bytes) -> bytes:
    return Packer().text(text.decode()).done()


HESAI = "hesai_ros_driver/msg/UdpFrame"
PANDAR = "pandar_msgs/msg/PandarScan"
NEBULA = "nebula_msgs/msg/NebulaPackets"


@dataclass(frozen=True)
class Hesai:
    """A sensor of Hesai: how its packets look, after the manual of each model.

    Attributes:
        head: bytes before the blocks; empty: each block begins with FF EE.
        unit: bytes of a return.
        tail: what stands behind the blocks, of the return mode, the date (6 bytes) and the microseconds.
        block_us: time of the last block after that of the packet, and between blocks; of a QT of the first block.
    """

    lasers: int
    blocks: int
    head: bytes
    unit: int
    tail: Callable[[int, bytes, int], bytes]
    block_us: tuple[float, float]
    sequence: bytes = b""
    years_from: int = 1900

    def block_s(self, block: int, returns: int = 1) -> float:
        last_us, step_us = self.block_us
        steps = block // returns if self is QT64 else -((self.blocks - 1 - block) // returns)
        return 1e-6 * (last_us + step_us * steps)

    def packet(
        self, azimuths: Sequence[float], units: NDArray[Any], intensity: NDArray[Any], stamp_ns: int, mode: int = 0x37
    ) -> bytes:
        """Of (blocks, lasers) ranges in units of 4 mm; azimuths in degrees."""
        packet = self.head
        for azimuth, ranges, intensities in zip(azimuths, units, intensity, strict=True):
            packet += b"" if self.head else b"\xff\xee"
            packet += struct.pack("<H", round(100.0 * azimuth) % 36_000)
            for one, strength in zip(ranges.tolist(), intensities.tolist(), strict=True):
                packet += struct.pack("<HB", round(one), round(strength)) + bytes(self.unit - 3)
        seconds, rest_ns = divmod(stamp_ns, 10**9)
        when = datetime.fromtimestamp(seconds, UTC)
        date = bytes([when.year - self.years_from, when.month, when.day, when.hour, when.minute, when.second])
        return packet + self.tail(mode, date, rest_ns // 1000) + self.sequence

    def packets(
        self, units: NDArray[Any], intensity: NDArray[Any], begin_ns: int, step_ns: float, first_deg: float = 0.0
    ) -> list[bytes]:
        """Packets of a turn of (columns, lasers) ranges that begins at an azimuth."""
        columns, packets = len(units), []
        for first in range(0, columns, self.blocks):
            last = 0 if self is QT64 else self.blocks - 1
            stamp_ns = begin_ns + round((first + last) * step_ns - 1e9 * self.block_s(last))
            azimuths = [first_deg + 360.0 * (first + block) / columns for block in range(self.blocks)]
            part = slice(first, first + self.blocks)
            packets.append(self.packet(azimuths, units[part], intensity[part], stamp_ns))
        return packets


def _tail_40(mode: int, date: bytes, micros: int) -> bytes:
    return bytes(8) + struct.pack("<HIBB", 600, micros, mode, 0x42) + date


def _tail_qt(mode: int, date: bytes, micros: int) -> bytes:
    return bytes(10) + struct.pack("<HIBB", 600, micros, mode, 0x42) + date


def _tail_xt(mode: int, date: bytes, micros: int) -> bytes:
    return bytes(10) + struct.pack("<BH", mode, 600) + date + struct.pack("<IB", micros, 0x42)


def _tail_128(mode: int, date: bytes, micros: int) -> bytes:
    """CRC, functional safety; behind it sequence, IMU and CRC."""
    return bytes(4 + 17 + 9 + 3) + struct.pack("<BH", mode, 600) + date + struct.pack("<IB", micros, 0x42) + bytes(30)


def _head(version: tuple[int, int], lasers: int, blocks: int, flags: int) -> bytes:
    return bytes([0xEE, 0xFF, *version, 0, 0, lasers, blocks, 0, 4, 1, flags])


P40 = Hesai(40, 10, b"", 3, _tail_40, (-57.6, 55.56), years_from=2000)
P64 = Hesai(64, 6, bytes([0xEE, 0xFF, 64, 6, 0, 4, 0, 0]), 3, _tail_40, (-71.6, 55.56), bytes(4), 2000)
QT64 = Hesai(64, 4, _head((3, 1), 64, 4, 1), 4, _tail_qt, (105.1, 166.7), bytes(4))
XT16 = Hesai(16, 8, _head((6, 1), 16, 8, 1), 4, _tail_xt, (29.0, 50.0), bytes(4))
XT32 = Hesai(32, 8, _head((6, 1), 32, 8, 1), 4, _tail_xt, (29.0, 50.0), bytes(4))
XTM = Hesai(32, 6, _head((6, 1), 32, 6, 1), 4, _tail_xt, (29.0, 50.0), bytes(4))
P128 = Hesai(128, 2, _head((1, 4), 128, 2, 7), 3, _tail_128, (27.0, 55.56))
HESAIS = {"40P": P40, "64": P64, "QT64": QT64, "XT-16": XT16, "XT-32": XT32, "XTM": XTM, "128": P128}


def correction_file(elevations: Sequence[float], azimuths: Sequence[float], form: str = "Channel") -> bytes:
    """In degrees, as Hesai's web page gives it."""
    lines = [
        f"{number},{one:.3f},{other:.3f}"
        for number, (one, other) in enumerate(zip(elevations, azimuths, strict=True), 1)
    ]
    return "\r\n".join([f"{form},Elevation,Azimuth", *lines, ""]).encode()


def hesai_message(
    packets: Sequence[bytes], type_name: str = HESAI, fixed: int = 0, sec: int = 5, frame: str = "hesai"
) -> bytes:
    """`fixed`: the bytes that each packet has, whatever its size, in an old form of the message."""
    packer = Packer().header(frame, sec, 0).put("I", len(packets))
    for packet in packets:
        if type_name != HESAI:
            packer.put("I", sec, 0)
        if fixed:
            packer.body += packet.ljust(fixed, b"\0")
        else:
            packer.octets(packet)
        if type_name != NEBULA:
            packer.put("I", len(packet))
    return packer.done()


def hesai_message_of_ros_1(packets: Sequence[bytes]) -> bytes:
    """A `PandarScan`, in which nothing is aligned."""
    data = struct.pack("<IIII", 7, 5, 0, 5) + b"hesai" + struct.pack("<I", len(packets))
    for packet in packets:
        data += struct.pack("<III", 5, 0, len(packet)) + packet + struct.pack("<I", len(packet))
    return data


ROBOSENSE = "rslidar_msg/msg/RslidarPacket"


@dataclass(frozen=True)
class Robosense:
    """A sensor of RoboSense, after the manual of each model.

    Attributes:
        unit_mm: of ranges.
        lens_m: from the axis to the lens.
        lasers_us: when each laser fires after the first one.
        firing_us: time between firings.
    """

    lasers: int
    unit_mm: float
    lens_m: float
    lasers_us: tuple[float, ...]
    firing_us: float
    is_helios: bool = False

    @property
    def in_block(self) -> int:
        """Firings in a block of 32 returns."""
        return 32 // self.lasers

    def directions(self) -> tuple[list[float], list[float]]:
        """Elevations and azimuths in degrees, near those of the model, in the order of the channels."""
        if self.lasers == 16:
            sizes = [15.0 - 2.0 * step + 0.01 * step for step in range(8)]
            return [-one for one in sizes] + sizes, [0.0] * 16
        order = np.random.default_rng(4).permutation(32)
        low, high = (-16.0, 15.0) if self.is_helios else (-25.0, 15.0)
        return np.linspace(low, high, 32)[order].tolist(), np.round(np.linspace(-8.0, 8.0, 32), 2).tolist()

    def difop(
        self, *, dual: bool = False, blank: bool = False, directions: tuple[list[float], list[float]] | None = None
    ) -> bytes:
        packet = bytearray(1248)
        packet[:8] = bytes.fromhex("a5ff005a11115555")
        packet[300] = 0 if dual else 4 if self.is_helios else 1
        elevations, azimuths = directions or self.directions()
        if self.lasers == 16 and not blank:
            packet[1165:1213] = b"".join(round(1e4 * abs(one)).to_bytes(3, "big") for one in elevations)
        elif not blank:
            per_degree = 100 if self.is_helios else 1000
            signed = [(one < 0, round(per_degree * abs(one))) for one in (*elevations, *azimuths)]
            packet[468:660] = b"".join(struct.pack(">BH", *one) for one in signed)
        return bytes(packet)

    def packet(
        self, azimuths: Sequence[float] | NDArray[Any], units: NDArray[Any], intensity: NDArray[Any], stamp_ns: int
    ) -> bytes:
        """Of (12, 32) ranges in units."""
        seconds, rest_ns = divmod(stamp_ns, 10**9)
        if self.is_helios:
            head = (
                bytes.fromhex("55aa055a") + bytes(16) + seconds.to_bytes(6, "big") + struct.pack(">I", rest_ns // 1000)
            )
        else:
            when = datetime.fromtimestamp(seconds, UTC)
            date = [when.year - 2000, when.month, when.day, when.hour, when.minute, when.second]
            parts = struct.pack(">HH", rest_ns // 10**6, rest_ns // 1000 % 1000)
            head = bytes.fromhex("55aa050a5aa550a0") + bytes(12) + bytes(date) + parts
        packet = head.ljust(42, b"\0")
        for azimuth, ranges, intensities in zip(azimuths, units.tolist(), intensity.tolist(), strict=True):
            packet += struct.pack(">HH", 0xFFEE, round(100.0 * azimuth) % 36_000)
            packet += b"".join(struct.pack(">HB", *one) for one in zip(ranges, intensities, strict=True))
        return packet + bytes(6)

    def packets(
        self, units: NDArray[Any], intensity: NDArray[Any], begin_ns: int, step_ns: float, first_deg: float = 0.0
    ) -> list[bytes]:
        """Packets of a turn of (blocks, 32) ranges."""
        azimuths = first_deg + 360.0 * np.arange(len(units)) / len(units)
        return [
            self.packet(
                azimuths[at : at + 12], units[at : at + 12], intensity[at : at + 12], begin_ns + round(at * step_ns)
            )
            for at in range(0, len(units), 12)
        ]


_LASERS_32_US = (*(2.88 * laser for laser in range(15)), 44.64, *(1.44 + 2.88 * laser for laser in range(15)), 46.08)
RS_16 = Robosense(16, 5.0, 0.03825, tuple(2.8 * laser for laser in range(16)), 55.5)
RS_32 = Robosense(32, 5.0, 0.03997, _LASERS_32_US, 55.52)
HELIOS = Robosense(32, 2.5, 0.03498, tuple(1.73 * laser for laser in range(32)), 55.56, is_helios=True)
ROBOSENSES = {"RS-16": RS_16, "RS-32": RS_32, "Helios": HELIOS}


def robosense_message(packet: bytes, frame: str = "rslidar", begin: bool = False) -> bytes:
    packer = Packer().header(frame, 5, 0).put("B", packet[0] == 0xA5, begin)
    return packer.octets(packet).done()


def bytes_message(data: bytes) -> bytes:
    """`std_msgs/UInt8MultiArray` without dimensions."""
    return Packer().put("I", 0, 0).octets(data).done()


def gridded(sweep: LidarFrame, columns: int, beams: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Ranges in m and intensities of a simulated sweep, (columns, beams): columns turn clockwise from the rear."""
    assert sweep.ring is not None
    assert sweep.intensity is not None
    azimuth = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]).astype(np.float64)
    column = np.rint((np.pi - azimuth) / (2.0 * np.pi) * columns - 0.5).astype(int) % columns
    ranges, intensity = np.zeros((columns, beams)), np.zeros((columns, beams))
    ranges[column, sweep.ring] = np.linalg.norm(sweep.xyz_m.astype(np.float64), axis=1)
    intensity[column, sweep.ring] = sweep.intensity
    return ranges, intensity


def write_entries(path: Path, entries: Iterable[Entry], encoding: str = "cdr") -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        for time, topic, name, data in entries:
            if topic not in channels:
                schema = writer.register_schema(name, "ros2msg" if encoding == "cdr" else "ros1msg", b"")
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


STRING = messages.STRING
