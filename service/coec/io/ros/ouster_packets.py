"""Packets of Ouster's LiDARs as sweeps: every profile of points of firmware 2.0 to 4.0, by the sensor's metadata.

A message (`PacketMsg`) holds one packet, with some columns of a sweep; each column has its own time and its number in
the turn, and the range of each beam in 1 mm, in the profiles of 15 bits in 8 mm. The first return is read. Points are
in the LiDAR's frame (`os_lidar`), as ouster_ros gives them; the pose of that frame in the sensor comes from the
metadata, too.

Source: Ouster's firmware user manual, "Lidar data packet format", and "Lidar range to XYZ" of its sensor
documentation; checked against ouster-sdk 1.0.1.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal, lidar_frame
from coec.io.ros.messages import MessageCursor

DESCRIBED: Final = b"beam_altitude_angles"
"""What metadata have in their text."""

MISSING: Final = (
    "there are packets of an Ouster, but no metadata: its driver publishes them on the topic `metadata` beside that of "
    "the packets (record that, too; live, on another topic: lidar.metadata_topic), or give the JSON that ouster_ros or "
    "Ouster Studio saves: ?metadata=FILE of a recording, lidar.metadata of the service"
)

MAX_BEAMS, MAX_COLUMNS, MAX_PACKET_COLUMNS = 256, 8192, 128
"""Twice what the largest model has in a column, a turn and a packet."""

MAX_SWEEP_BYTES: Final = 2**24
"""Most bytes of the packets of a sweep. The largest has 8.4 MB: 4096 columns of 128 beams with 16 bytes a pixel."""

MAX_NUMBER: Final = 1e6
"""Largest number of the metadata that is used: a kilometre."""

_GLIMPSE: Final = 48
"""Bytes of a packet that the index keeps: the packet's header and that of its first column."""

_SIGNAL: Final = "<u2"


@dataclass(frozen=True, slots=True)
class Profile:
    """How the pixel of a beam is packed: its bytes; the bits of the range, which begin at the first byte; type and
    place of the intensity."""

    size: int
    range_bits: int
    intensity: tuple[str, int]

    @property
    def range_m(self) -> float:
        """Unit of the range."""
        return 0.008 if self.range_bits == 15 else 0.001


PROFILES: Final[Mapping[str, Profile]] = {
    "LEGACY": Profile(12, 20, (_SIGNAL, 6)),
    "RNG19_RFL8_SIG16_NIR16": Profile(12, 19, (_SIGNAL, 6)),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(16, 19, (_SIGNAL, 8)),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": Profile(12, 19, (_SIGNAL, 6)),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": Profile(16, 19, (_SIGNAL, 8)),
    "RNG19_RFL8_SIG16_NIR16_RGB16": Profile(16, 19, (_SIGNAL, 4)),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": Profile(20, 19, (_SIGNAL, 8)),
    "FIVE_WORD_PIXEL": Profile(20, 19, (_SIGNAL, 8)),
    "RNG15_RFL8_NIR8": Profile(4, 15, ("u1", 2)),
    "RNG15_RFL8_WIN8": Profile(4, 15, ("u1", 2)),
    "RNG15_RFL8_NIR8_DUAL": Profile(8, 15, ("u1", 2)),
    "FUSA_RNG15_RFL8_NIR8_DUAL": Profile(8, 15, ("u1", 2)),
    "RNG15_RFL8_NIR8_ZONE16": Profile(8, 15, ("u1", 2)),
}
"""By `udp_profile_lidar`. Profiles of 15 bits have no signal; their reflectivity is the intensity."""


def glimpse(payload: bytes) -> bytes:
    """What the index keeps of a message in CDR: the size of its packet in four bytes, and the packet's beginning.

    Raises:
        DecodeError: `message_malformed`.
    """
    packet = _packet(payload)
    return len(packet).to_bytes(4, "little") + bytes(packet[:_GLIMPSE])


def _packet(payload: bytes) -> memoryview:
    size = MessageCursor(payload).number()
    if size > len(payload) - 8:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the packet is cut off")
    return memoryview(payload)[8 : 8 + size]


def sensor_of(glimpses: Sequence[bytes], metadata: bytes | None) -> OusterSensor:
    """The sensor that these describe, which sent some packets.

    Raises:
        DecodeError: `message_type`: there are no metadata; or as `OusterSensor.from_metadata`.
    """
    del glimpses
    if metadata is None:
        raise DecodeError(Refusal.MESSAGE_TYPE, MISSING)
    return OusterSensor.from_metadata(metadata[max(metadata.find(b"{"), 0) :].rstrip(b"\0"))


@dataclass(frozen=True, slots=True, eq=False)
class OusterSensor:
    """A sensor, as its metadata describe it.

    Attributes:
        packet: (one packet) its layout: `frame`, and `columns` with `time_ns`, `number`, `status` and `pixels`.
        columns: columns of a turn.
        altitude_rad, azimuth_rad: (H,) directions of the beams; azimuths count clockwise.
        beam_origin_m: x and z of the origin of the beams in the LiDAR's frame.
        T_sensor_lidar: (4, 4) pose of the LiDAR's frame in the sensor's.
    """

    profile: str
    packet: np.dtype[Any]
    columns: int
    altitude_rad: NDArray[np.float64]
    azimuth_rad: NDArray[np.float64]
    beam_origin_m: tuple[float, float]
    T_sensor_lidar: Matrix4

    @classmethod
    def from_metadata(cls, text: bytes) -> OusterSensor:
        """From the JSON of the sensor, in the form of any firmware.

        Raises:
            DecodeError: `message_malformed`: it is not metadata, or lacks something; `message_type`: a profile that is
                not read.
        """
        try:
            document = json.loads(text)
            sections = [document, *(part for part in document.values() if isinstance(part, dict))]
            values = {name: value for section in reversed(sections) for name, value in section.items()}
            altitude_deg = _numbers(values["beam_altitude_angles"], MAX_BEAMS)
            azimuth_deg = _numbers(values["beam_azimuth_angles"], MAX_BEAMS)
            origin_mm = (float(_numbers([values.get("lidar_origin_to_beam_origin_mm", 0.0)], 1)[0]), 0.0)
            if "beam_to_lidar_transform" in values:
                T = _numbers(values["beam_to_lidar_transform"], 16).reshape(4, 4)
                origin_mm = (float(T[0, 3]), float(T[2, 3]))
            T_sensor_lidar = _numbers(values["lidar_to_sensor_transform"], 16).reshape(4, 4).copy()
            T_sensor_lidar[:3, 3] *= 1e-3
            if not np.allclose(T_sensor_lidar[:3, :3] @ T_sensor_lidar[:3, :3].T, np.eye(3), atol=1e-3):
                raise ValueError("no rotation")
            profile, packet, columns = _layout(values, len(altitude_deg))
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            what = f" (no {error})" if isinstance(error, KeyError) else ""
            raise DecodeError(Refusal.MESSAGE_MALFORMED, f"this is no metadata of an Ouster{what}") from error
        if len(azimuth_deg) != len(altitude_deg):
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "the metadata of the Ouster has more angles than beams")
        angles = np.radians(altitude_deg), np.radians(azimuth_deg)
        x_m, z_m = (1e-3 * value for value in origin_mm)
        return cls(profile, packet, columns, *angles, (x_m, z_m), T_sensor_lidar)

    @property
    def name(self) -> str:
        """See `PacketSensor`."""
        return f"Ouster with {len(self.altitude_rad)} beams ({self.profile})"

    @property
    def frame_id(self) -> str:
        """See `PacketSensor`."""
        return "os_lidar"

    @property
    def pose(self) -> tuple[str, Matrix4]:
        """See `PacketSensor`."""
        return "os_sensor", self.T_sensor_lidar

    @property
    def notes(self) -> tuple[Recognition, ...]:
        """What is to be said of the points."""
        if PROFILES[self.profile].range_bits != 15:
            return ()
        text = f"The packets of the LiDAR ({self.profile}) have ranges in steps of 8 mm, and no signal."
        return (Recognition("coarse_ranges", text),)

    def heads(self, glimpses: Sequence[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `PacketSensor`; of a packet, only the time of the first column is known.

        Raises:
            DecodeError: `message_malformed`: no packet has the size that the metadata say.
        """
        size = self.packet.itemsize
        known = np.array([int.from_bytes(one[:4], "little") == size for one in glimpses])
        if not known.any():
            raise DecodeError(
                Refusal.MESSAGE_MALFORMED,
                f"no packet has the {size} bytes that the metadata of the Ouster say ({self.profile}, "
                f"{len(self.altitude_rad)} beams): are they of another sensor?",
            )
        heads = np.frombuffer(
            b"".join(one[4:] for one, one_known in zip(glimpses, known, strict=True) if one_known), "u1"
        )
        heads = heads.reshape(-1, _GLIMPSE)
        time_at = self.packet.fields["columns"][1]  # type: ignore[index]
        frame, frame_at = self.packet.fields["frame"][:2]  # type: ignore[index]
        times_ns, numbers = np.zeros((len(known), 2), np.int64), np.full(len(known), -1, np.int64)
        times = np.ascontiguousarray(heads[:, time_at : time_at + 8]).view("<u8")[:, 0]
        times_ns[known] = np.minimum(times, np.uint64(2**62)).astype(np.int64)[:, None]
        numbers[known] = np.ascontiguousarray(heads[:, frame_at : frame_at + frame.itemsize]).view(frame)[:, 0]
        return times_ns, numbers

    def sweep(self, payloads: Sequence[bytes], at_ns: int, stamp_ns: int) -> LidarFrame:
        """The points of a sweep, in the LiDAR's frame, column by column.

        Args:
            payloads: its messages.
            at_ns, stamp_ns: the instant from which its points are timed, by the sensor's clock and by that of the
                recording.

        Raises:
            DecodeError: `message_malformed`, `cloud_empty`, `cloud_time`.
        """
        packets = [packet for packet in map(_packet, payloads) if len(packet) == self.packet.itemsize]
        if len(packets) * self.packet.itemsize > MAX_SWEEP_BYTES:
            raise DecodeError(Refusal.CLOUD_TOO_LARGE, f"a sweep has at most {MAX_SWEEP_BYTES} bytes of packets")
        columns = np.frombuffer(b"".join(packets), self.packet)["columns"].ravel()
        columns = columns[(columns["status"] & 1 == 1) & (columns["number"] < self.columns)]
        pixels = columns["pixels"]
        ranges = pixels["range"] & (2 ** PROFILES[self.profile].range_bits - 1)
        column, beam = np.nonzero(ranges)
        x_m, z_m = self.beam_origin_m
        turned_rad = 2.0 * np.pi * (1.0 - columns["number"].astype(np.float64) / self.columns)
        azimuth_rad = turned_rad[column] - self.azimuth_rad[beam]
        along_m = ranges[column, beam] * PROFILES[self.profile].range_m - np.hypot(x_m, z_m)
        level_m = along_m * np.cos(self.altitude_rad)[beam]
        xyz_m = np.empty((len(beam), 3), np.float32)
        xyz_m[:, 0] = level_m * np.cos(azimuth_rad) + x_m * np.cos(turned_rad)[column]
        xyz_m[:, 1] = level_m * np.sin(azimuth_rad) + x_m * np.sin(turned_rad)[column]
        xyz_m[:, 2] = along_m * np.sin(self.altitude_rad)[beam] + z_m
        after_s = (columns["time_ns"] - np.uint64(at_ns)).view(np.int64) * 1e-9
        intensity = pixels["intensity"][column, beam].astype(np.float32)
        ring, time_s = beam.astype(np.uint16), after_s[column].astype(np.float32)
        by = f"column times of {self.profile}"
        return lidar_frame(stamp_ns, self.frame_id, xyz_m, intensity, ring, time_s, timed_by=by)


def _numbers(values: Any, most: int) -> NDArray[np.float64]:
    """A list of numbers: angles in degrees, lengths in millimetres."""
    if not isinstance(values, list) or not 0 < len(values) <= most:
        raise ValueError("not as many numbers as expected")
    numbers = np.array([float(value) for value in values])
    if not (np.abs(numbers) <= MAX_NUMBER).all():
        raise ValueError("not finite, or out of range")
    return numbers


_MODE: Final = re.compile(r"(\d{3,4})x(\d{1,2})")


def _layout(values: Mapping[str, Any], beams: int) -> tuple[str, np.dtype[Any], int]:
    """Profile, layout of a packet, and columns of a turn."""
    form = values.get("lidar_data_format", values.get("data_format"))
    if not isinstance(form, dict):  # firmware before 2.0
        mode = _MODE.fullmatch(str(values["lidar_mode"]))
        form = {"columns_per_frame": 0 if mode is None else int(mode[1])}
    profile = str(form.get("udp_profile_lidar", "LEGACY"))
    in_packet, columns = int(form.get("columns_per_packet", 16)), int(form["columns_per_frame"])
    if profile not in PROFILES:
        known = ", ".join(PROFILES)
        text = f"packets of an Ouster with the profile {profile[:64]!a}: {known} are read"
        raise DecodeError(Refusal.MESSAGE_TYPE, text)
    if int(form.get("pixels_per_column", beams)) != beams:
        raise ValueError("not as many angles as beams")
    if not (0 < in_packet <= MAX_PACKET_COLUMNS and 0 < columns <= MAX_COLUMNS):
        raise ValueError("impossible columns")
    legacy, safe = profile == "LEGACY", form.get("header_type") == "FUSA"
    head, tail = (16, 4) if legacy else (12, 0)
    pixel = PROFILES[profile]
    pixels = np.dtype(
        {
            "names": ["range", "intensity"],
            "formats": ["<u2" if pixel.range_bits == 15 else "<u4", pixel.intensity[0]],
            "offsets": [0, pixel.intensity[1]],
            "itemsize": pixel.size,
        }
    )
    size = head + beams * pixel.size + tail
    column = np.dtype(
        {
            "names": ["time_ns", "number", "status", "pixels"],
            "formats": ["<u8", "<u2", "<u2", (pixels, (beams,))],
            "offsets": [0, 8, size - tail if legacy else 10, head],
            "itemsize": size,
        }
    )
    # Before and behind the columns, packets other than LEGACY have 32 bytes.
    around = 0 if legacy else 32
    packet = np.dtype(
        {
            "names": ["frame", "columns"],
            "formats": ["<u4" if safe and not legacy else "<u2", (column, (in_packet,))],
            "offsets": [10 if legacy else 4 if safe else 2, around],
            "itemsize": 2 * around + in_packet * size,
        }
    )
    return profile, packet, columns
