"""Pictures within a page: small ones as they are, the others shrunk until all of them fit."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.codec import decode_bgr, probe
from coec.calibration.types import EncodedImage
from coec.config import LimitsConfig
from coec.errors import DecodeError

BUDGET_BYTES = 2_000_000
"""Limit for all pictures of a page: base64 makes 2.7 MB of it, and a page shall not be larger than 3 MB."""

LADDER = ((1920, 90), (1600, 84), (1400, 80), (1200, 76), (1000, 72), (800, 66), (640, 60), (480, 50))
"""Largest side (px) and WebP quality of all pictures that are too large as they are; the first step with which they fit
is taken. A page is at most 1040 px wide, and a screen may have two pixels for each of those."""

SMALL_SHARE = 1 / 8
"""A picture of at most this share of the budget stays as it is, to the byte."""

LIMITS = LimitsConfig()
"""Limits of a picture, because some come from a vehicle."""


@dataclass(frozen=True, slots=True)
class Embedded:
    """A picture as it stands in the page: its address, and its size, px."""

    uri: str
    width: int
    height: int


def embedded(pictures: Sequence[bytes], budget_bytes: int = BUDGET_BYTES) -> list[Embedded]:
    """All pictures of a page (bytes of PNG or JPEG files) in their order, together within the budget.

    Raises:
        DecodeError: one is no such picture, or there are so many that they do not fit even in the smallest form.
    """
    probed = [probe(data, LIMITS) for data in pictures]
    small = [len(data) <= SMALL_SHARE * budget_bytes for data in pictures]
    pixels = [None if as_is else decode_bgr(image, LIMITS) for image, as_is in zip(probed, small, strict=True)]
    for side_px, quality in LADDER:
        made = [
            _as_it_is(image) if large is None else _smaller(large, side_px, quality)
            for image, large in zip(probed, pixels, strict=True)
        ]
        if sum(len(data) for _, data in made) <= budget_bytes:
            return [
                Embedded(f"data:image/{kind};base64,{base64.b64encode(data).decode()}", image.width, image.height)
                for (kind, data), image in zip(made, probed, strict=True)
            ]
    raise DecodeError("pictures_too_large", f"{len(pictures)} pictures do not fit into one page: leave some out")


def _as_it_is(image: EncodedImage) -> tuple[str, bytes]:
    return image.format.value, bytes(image.data)


def _smaller(pixels: NDArray[np.uint8], side_px: int, quality: int) -> tuple[str, bytes]:
    share = side_px / max(pixels.shape[:2])
    shown = cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) if share < 1.0 else pixels
    return "webp", cv2.imencode(".webp", shown, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
