"""Packets of LiDARs, packed by hand after the manuals of their makers; and drives whose sweeps are in such packets."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
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
