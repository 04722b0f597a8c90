"""Streams of video: packed by hand after ITU-T H.264, as far as `coec` reads them itself, and encoded by FFmpeg."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

START = b"\0\0\0\1"

FORMATS = {"libx264": "h264", "libx265": "h265"}
"""Format in messages, by FFmpeg's encoder."""


def _unit(head: int, bits: str) -> bytes:
    """A unit of its first byte, and bits to which the stop bit is added."""
    whole = bits + "1" + "0" * (-(len(bits) + 1) % 8)
    return START + bytes([head]) + int(whole, 2).to_bytes(len(whole) // 8, "big")


def ue(value: int) -> str:
    """A number in the code of Exp-Golomb."""
    text = f"{value + 1:b}"
    return "0" * (len(text) - 1) + text


def parameters(size: int = 4, *, gaps: bool = False, high: bool = False, order: int = 2) -> bytes:
    """A sequence parameter set whose pictures count with `size` bits, up to the flag of gaps, and a picture parameter
    set."""
    profile = f"{100 if high else 66:08b}" + f"{0:08b}{30:08b}" + ue(0)
    # Chroma 4:2:0, 8 bits, no bypass; of eight scaling lists the first is given and ends at once.
    profile += (ue(1) + ue(0) + ue(0) + "0" + "1" + "1" + ue(16) + "0" * 7) if high else ""
    orders = {0: ue(0), 1: "0" + ue(0) + ue(0) + ue(2) + ue(0) + ue(1), 2: ""}
    return _unit(0x67, profile + ue(size - 4) + ue(order) + orders[order] + ue(1) + f"{gaps:d}") + _unit(0x68, "1010")


def slice_of(number: int, size: int = 4, *, key: bool = False, reference: bool = True) -> bytes:
    """The head of a slice, and of its data nothing."""
    head = (0x60 if reference else 0x00) | (5 if key else 1)
    return _unit(head, ue(0) + ue(7 if key else 5) + ue(0) + f"{number % (1 << size):0{size}b}" + "0" * 24)


@dataclass(frozen=True)
class Packet:
    """A packet of an encoder, and the number of its picture."""

    data: bytes
    picture: int


def pictures(count: int, width: int = 64, height: int = 48) -> list[NDArray[np.uint8]]:
    """Blocks of colour that move."""
    small = np.random.default_rng(0).integers(20, 230, (height // 8, width // 8, 3), dtype=np.uint8)
    first = cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)
    return [np.ascontiguousarray(np.roll(first, (k, 2 * k), (0, 1))) for k in range(count)]


def encoded(
    encoder: str, images: Sequence[NDArray[np.uint8]], *, gop: int = 5, between: int = 0, **options: str
) -> list[Packet]:
    """Packets of FFmpeg's encoder, in the order of decoding: a key frame every `gop` pictures, and up to `between`
    pictures in a row that depend on later ones."""
    av = pytest.importorskip("av", reason="needs the extra video")
    context: Any = av.CodecContext.create(encoder, "w")
    context.height, context.width = images[0].shape[:2]
    context.pix_fmt, context.time_base, context.gop_size = "yuv420p", Fraction(1, 30), gop
    context.max_b_frames, context.thread_count = between, 1
    context.options = {"x265-params": "log-level=none:pools=none:frame-threads=1", **options}
    packets: list[Any] = []
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts = number
        packets += context.encode(frame)
    return [Packet(bytes(each), each.pts) for each in itertools.chain(packets, context.encode(None))]
