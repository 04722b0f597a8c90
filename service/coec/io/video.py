"""Video in recordings: which packets of an H.264 or H.265 stream hold pictures that can be decoded, and these pictures,
decoded by FFmpeg through `av`, the library of the optional extra `video`.

A packet holds one picture as NAL units (annex B of ITU-T H.264 and H.265), and depends on the packets since the last
key frame. What comes before the first key frame is left out. After a lost packet a decoder shows smeared pictures
without a word; therefore gaps in `frame_num` are looked for (H.264, 7.4.3), of H.265 the decoder reports the missing
reference, and pictures up to the next key frame are left out.

Only parameter sets and slices are given to the decoder, on one thread, so that every pass gives the same bits. It
refuses sizes above `MAX_PIXELS` before it allocates anything.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from coec.calibration.types import EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError, SourceError
from coec.io.frame_validation import Refusal, raw_image

MAX_PIXELS: Final = 4096 * 4096
"""Largest picture of a video. A decoder keeps up to 17 of them, of 1.5 bytes a pixel: 430 MB."""

MAX_DELAY: Final = 16
"""Most pictures that a decoder keeps back to put them into order (`max_dec_frame_buffering`)."""

MAX_PARAMETER_BYTES: Final = 1 << 16
"""Longest parameter sets before a picture; encoders write some 100 bytes."""

MAX_UNITS: Final = 64
"""Most units before the first slice of a packet: delimiter, parameter sets, and supplemental information."""

_START: Final = b"\0\0\1"
_HEAD_BYTES: Final = 512
"""First bytes of a unit in which the fields that are read stand."""

_HIGH_PROFILES: Final = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)
"""Values of `profile_idc` whose parameter sets say more (H.264, 7.3.2.1.1)."""

Place = tuple[int, ...]


def codec_of(name: str) -> str | None:
    """`h264` or `hevc`, by the name of a format (Foxglove), a codec or an encoder (FFmpeg), which other words may
    follow; None for others."""
    first = name.partition(";")[0].strip().lower()
    return "h264" if "264" in first else "hevc" if "265" in first or "hevc" in first else None


@dataclass(frozen=True, slots=True)
class VideoPacket:
    """A packet: where its message lies, and with which parameter sets decoding can begin at it; None: it cannot."""

    at: Place
    parameters: bytes | None


@dataclass(slots=True)
class VideoTrack:
    """The packets of a stream, in the order in which they were recorded, which is that of decoding.

    Attributes:
        codec: as `codec_of` names it.
        packets: all that can be decoded.
        left_out: number of other pictures, by cause.
    """

    codec: str
    packets: list[VideoPacket] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    _parameters: bytes = b""
    _sequence: _Sequence | None = None
    _cause: str = "before the first key frame"
    _reference: int | None = None

    def add(self, data: bytes, at: Place) -> bool:
        """Adds the data of a packet. Returns whether it holds a picture that can be decoded."""
        try:
            parameters, picture = _units(data, self.codec)
            if parameters:
                self._parameters = parameters
                self._sequence = _sequence_of(parameters) if self.codec == "h264" else None
            if picture is None:
                return False
            is_key, is_lost = self._key_or_lost(picture)
        except DecodeError:
            self._cause = "damaged, or after a damaged one"
            self.left_out[self._cause] += 1
            return False
        if is_key:
            self._cause = ""
        elif is_lost and not self._cause:
            self._cause = "after a lost packet, up to the next key frame"
        if self._cause:
            self.left_out[self._cause] += 1
            return False
        self.packets.append(VideoPacket(at, self._parameters if is_key else None))
        return True

    def _key_or_lost(self, unit: bytes) -> tuple[bool, bool]:
        """Whether a picture is a key frame, and whether one on which it depends is missing."""
        if self.codec != "h264":
            return 16 <= unit[0] >> 1 & 0x3F <= 23, False
        if self._sequence is None:
            return False, False
        is_key, number = unit[0] & 0x1F == 5, self._sequence.frame_number(unit)
        before = self._reference
        if unit[0] & 0x60 or is_key:
            self._reference = number
        follows = before is None or (number - before) % self._sequence.numbers in (0, 1)
        return is_key, not (is_key or follows or self._sequence.may_have_gaps)


@dataclass(frozen=True, slots=True)
class _Sequence:
    """What a sequence parameter set of H.264 says of `frame_num`."""

    numbers: int
    has_planes: bool
    may_have_gaps: bool

    def frame_number(self, unit: bytes) -> int:
        """From the header of a slice (H.264, 7.3.3)."""
        bits = _Bits(unit[1:])
        for _ in range(3):
            bits.unsigned()
        bits.take(2 if self.has_planes else 0)
        return bits.take(self.numbers.bit_length() - 1)


def _sequence_of(parameters: bytes) -> _Sequence | None:
    """The last sequence parameter set (H.264, 7.3.2.1.1); None if there is none."""
    sets = [unit for unit in parameters.split(_START) if unit[:1] and unit[0] & 0x1F == 7]
    if not sets:
        return None
    bits = _Bits(sets[-1][1:])
    profile, has_planes = bits.take(8), False
    bits.take(16)
    bits.unsigned()
    if profile in _HIGH_PROFILES:
        colours = bits.unsigned()
        has_planes = colours == 3 and bits.take(1) == 1
        bits.unsigned()
        bits.unsigned()
        bits.take(1)
        if bits.take(1):
            for number in range(12 if colours == 3 else 8):
                _skip_scaling_list(bits, 16 if number < 6 else 64)
    size = bits.unsigned() + 4
    if size > 16:
        raise DecodeError(Refusal.IMAGE_CORRUPT, "a parameter set has numbers of more than 16 bits")
    order = bits.unsigned()
    if order == 0:
        bits.unsigned()
    elif order == 1:
        bits.take(1)
        bits.unsigned()
        bits.unsigned()
        for _ in range(min(bits.unsigned(), 255)):
            bits.unsigned()
    bits.unsigned()
    return _Sequence(1 << size, has_planes, bits.take(1) == 1)


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    if not bits.take(1):
        return
    last = scale = 8
    for _ in range(size):
        if scale:
            code = bits.unsigned()
            scale = (last + (code + 1 >> 1) * (1 if code % 2 else -1)) % 256
        last = scale or last


class _Bits:
    """Bits of a unit, from its first, without the bytes that keep start codes out."""

    def __init__(self, unit: bytes) -> None:
        head = unit[:_HEAD_BYTES].replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(head, "big"), 8 * len(head)

    def take(self, count: int) -> int:
        """The next bits as a number."""
        self._left -= count
        if self._left < 0:
            raise DecodeError(Refusal.IMAGE_TRUNCATED, "a unit of the video is cut off")
        return self._value >> self._left & (1 << count) - 1

    def unsigned(self) -> int:
        """The next number in the code of Exp-Golomb (H.264, 9.1)."""
        zeros = 0
        while not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


def _units(data: bytes, codec: str) -> tuple[bytes, bytes | None]:
    """The parameter sets before the first slice, in annex B, and the data from that slice on; None: there is none.

    Raises:
        DecodeError: the data is not annex B, or the parameter sets are too long.
    """
    at, parameters = data.find(_START), b""
    if at < 0:
        raise DecodeError(Refusal.IMAGE_CORRUPT, "a packet of the video has no start code")
    for _ in range(MAX_UNITS):
        begin = at + len(_START)
        end = data.find(_START, begin)
        if begin >= len(data):
            return parameters, None
        kind = data[begin] & 0x1F if codec == "h264" else data[begin] >> 1 & 0x3F
        if 1 <= kind <= 5 if codec == "h264" else kind < 32:
            return parameters, data[begin:]
        if kind in ((7, 8, 13, 15) if codec == "h264" else (32, 33, 34)):
            parameters += _START + data[begin : end if end >= 0 else len(data)].rstrip(b"\0")
        if len(parameters) > MAX_PARAMETER_BYTES:
            break
        if end < 0:
            return parameters, None
        at = end
    raise DecodeError(Refusal.IMAGE_CORRUPT, "a packet of the video has too much before its picture")


def require_decoder() -> None:
    """Raises SourceError, which says what to install, if the optional extra is not there."""
    if importlib.util.find_spec("av") is None:
        raise SourceError(
            "video is decoded with the optional extra `video`: pip install 'coec[video]'; or take the camera's topic "
            "of JPEG or of raw pixels"
        )


class VideoReader:
    """Decodes the pictures of a track. It is fast if they are asked for in the order in which they are shown."""

    def __init__(self, track: VideoTrack, read: Callable[[Place], bytes], limits: LimitsConfig) -> None:
        """`read` gives the data of the packet at a place.

        Raises:
            SourceError: the optional extra is not installed.
        """
        require_decoder()
        self._codec, self._packets, self._read, self._limits = track.codec, track.packets, read, limits
        self._number = {packet.at: number for number, packet in enumerate(track.packets)}
        self._starts = [number for number, packet in enumerate(track.packets) if packet.parameters is not None]
        self._decoder: Any = None
        self._fed = -1
        self._pending: dict[int, Any] = {}

    def picture(self, at: Place) -> EncodedImage | None:
        """The picture of the packet at a place, as `bgr8`; None if it cannot be decoded.

        Raises:
            DecodeError: `image_too_large`.
        """
        number = self._number[at]
        starts = [start for start in self._starts if start <= number]
        if number in self._pending or (self._fed >= starts[-1] - 1 and self._decoded(number)):
            return self._image(number)
        # Pictures that lead a key frame of H.265 depend on the one before it.
        for start in reversed(starts[-2:]):
            self._begin(start)
            if self._decoded(number):
                return self._image(number)
        return None

    def _begin(self, start: int) -> None:
        import av

        av.logging.set_level(av.logging.PANIC)
        self._decoder = av.CodecContext.create(self._codec, "r")
        self._decoder.thread_count = 1
        pixels = min(MAX_PIXELS, self._limits.max_image_pixels)
        self._decoder.options = {"max_pixels": str(pixels), "err_detect": "explode"}
        self._fed = start - 1
        self._pending = {}

    def _decoded(self, number: int) -> bool:
        """Feeds packets until a picture comes out. Returns whether it did."""
        import av

        while number not in self._pending and self._fed < number + MAX_DELAY and self._decoder is not None:
            following = self._fed + 1
            packet = None
            if following < len(self._packets):
                _, picture = _units(self._read(self._packets[following].at), self._codec)
                parameters = self._packets[following].parameters or b""
                packet = av.Packet(parameters + _START + (picture or b""))
                packet.pts = following
            try:
                frames: Sequence[Any] = self._decoder.decode(packet)
            except (av.error.FFmpegError, ValueError, MemoryError):
                frames = ()
            self._fed = following
            self._pending.update((frame.pts, frame) for frame in frames if not frame.is_corrupt)
            if packet is None:
                self._decoder = None
        return number in self._pending

    def _image(self, number: int) -> EncodedImage:
        shown = list(self._pending)
        frame = self._pending[number]
        for earlier in shown[: shown.index(number) + 1]:
            del self._pending[earlier]
        pixels = frame.to_ndarray(format="bgr24")
        return raw_image(ImageFormat.BGR8, frame.width, frame.height, pixels.tobytes(), self._limits)
