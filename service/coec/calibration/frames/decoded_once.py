"""Images that are used twice, once for the mask and once for what they show, but decoded once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.calibration.ports import ImageReader
from coec.calibration.types import CameraFrame

MAX_CACHED_BYTES = 64_000_000
"""Most bytes of decoded images that are kept: twenty-five of 2.5 megapixels. Their edge maps take as much, and each
image is dropped when its maps are made. Images beyond this are decoded again."""


class CachedImages:
    """An image reader that keeps images from their first use to their second."""

    def __init__(self, images: ImageReader) -> None:
        self._images = images
        self._cache: dict[int, NDArray[np.uint8]] = {}
        self._bytes = 0

    def first(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values of a frame; `grey` will be called for it later.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        grey = self._images.grey(frame)
        if id(frame) not in self._cache and self._bytes + grey.nbytes <= MAX_CACHED_BYTES:
            self._cache[id(frame)] = grey
            self._bytes += grey.nbytes
        return grey

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values; the reader then drops the image.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        cached = self._cache.pop(id(frame), None)
        if cached is None:
            return self._images.grey(frame)
        self._bytes -= cached.nbytes
        return cached
