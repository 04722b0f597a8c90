"""A picture in a terminal: each character shows two pixels, an upper half block and its background."""

from __future__ import annotations

import cv2
from rich.text import Text

from coec.adapters.images.codec import decode_bgr, probe
from coec.config import LimitsConfig

LIMITS = LimitsConfig(max_message_bytes=16 * 2**20, max_image_pixels=33_000_000)
"""Limits of a picture that came over a network."""


def half_block_text(jpeg: bytes, columns: int, rows: int) -> Text:
    """The picture in at most so many characters, with its proportions kept.

    Raises:
        DecodeError: it cannot be decoded, or is larger than a picture may be.
    """
    pixels = decode_bgr(probe(jpeg, LIMITS), LIMITS)
    height, width = pixels.shape[:2]
    scale = min(columns / width, 2 * rows / height)
    size = (max(round(width * scale), 1), max(round(height * scale / 2), 1) * 2)
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    text = Text(no_wrap=True)
    for upper, lower in zip(small[::2], small[1::2], strict=True):
        for above, below in zip(upper, lower, strict=True):
            text.append("▀", f"{_colour(above)} on {_colour(below)}")
        text.append("\n")
    return text


def _colour(bgr: object) -> str:
    blue, green, red = (int(value) for value in bgr)  # type: ignore[attr-defined]
    return f"#{red:02x}{green:02x}{blue:02x}"
