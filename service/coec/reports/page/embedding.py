"""Pictures within a page: as they are where they are small, else made smaller until all of them fit."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from coec.errors import DecodeError

BUDGET_BYTES = 2_000_000
"""Of all pictures of a page: base64 makes 2.7 MB of them, and a page shall not be larger than 3 MB."""

LADDER = ((1920, 90), (1600, 84), (1400, 80), (1200, 76), (1000, 72), (800, 66), (640, 60), (480, 50))
"""Largest side (px) and quality (WebP) of all pictures that are too large as they are; the first with which they fit is
taken. A page is at most 1040 px wide, a screen may have two pixels for each of those."""

SMALL_SHARE = 1 / 8
"""Of the budget: what is no larger stays as it is, to the byte."""

KINDS = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp"}
"""By the first bytes of a file."""


@dataclass(frozen=True, slots=True)
class Embedded:
    """A picture as it stands in the page: its address, and its size, px."""

    uri: str
    width: int
    height: int


def embedded(pictures: Sequence[bytes], budget_bytes: int = BUDGET_BYTES) -> list[Embedded]:
    """All pictures of a page (bytes of PNG, JPEG or WebP files), in their order, together within the budget.

    Raises:
        DecodeError: one is no such picture, or there are so many that not even the smallest form fits.
    """
    decoded = [_decoded(data) for data in pictures]
    for side_px, quality in LADDER:
        made = [
            data if len(data) <= SMALL_SHARE * budget_bytes else _smaller(image, side_px, quality)
            for data, image in zip(pictures, decoded, strict=True)
        ]
        if sum(map(len, made)) <= budget_bytes:
            sizes = [image.shape for image in decoded]
            return [Embedded(_uri(data), width, height) for data, (height, width, _) in zip(made, sizes, strict=True)]
    raise DecodeError("picture_too_large", f"{len(pictures)} pictures do not fit into one page: leave some out")


def _decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if _kind(data) else None
    if image is None:
        raise DecodeError("picture_malformed", "a picture of the page is no PNG, JPEG or WebP file")
    return image


def _smaller(image: np.ndarray, side_px: int, quality: int) -> bytes:
    share = side_px / max(image.shape[:2])
    if share < 1.0:
        image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1])


def _kind(data: bytes) -> str | None:
    return next((kind for magic, kind in KINDS.items() if data.startswith(magic)), None)


def _uri(data: bytes) -> str:
    return f"data:{_kind(data)};base64,{base64.b64encode(data).decode()}"
