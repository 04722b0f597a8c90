"""What the calibration flow asks of the outside world. Adapters implement these; tests fake them."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, DepthMap, ImageQuality

T = TypeVar("T")


class DepthModel(Protocol):
    """A virtual depth sensor: one camera frame in, one depth map out (METHOD, section 1)."""

    @property
    def identity(self) -> str:
        """sha256 of the network file in hexadecimal, or `precomputed`: part of every decision's hash."""
        ...

    def infer(self, frame: CameraFrame) -> DepthMap:
        """Depth of the frame, at the resolution of the network.

        Raises:
            DecodeError: the image or the precomputed map cannot be decoded, or there is no map.
        """
        ...


class ImageReader(Protocol):
    """Pixels of an exposure, for the witnesses that use the image itself."""

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        ...


class ImageInspector(Protocol):
    """Judges an exposure without keeping its pixels."""

    def inspect(self, frame: CameraFrame) -> ImageQuality:
        """Sharpness and exposure of the frame.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        ...


class ImageReducer(Protocol):
    """Makes exposures small enough to be recorded by the hundred."""

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        """The frame without its depth map, its image compressed if it was not.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """
        ...


class Progress(Protocol):
    """Receives how far a calibration has come; it cannot influence the result."""

    def step(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` parts of the stage are complete."""
        ...


class Silence:
    """A `Progress` for callers that do not want to know."""

    def step(self, stage: str, done: int, total: int) -> None:
        """Nothing."""


@dataclass(frozen=True, slots=True)
class Step:
    """A part of a long computation that is complete: `done` of `total` parts of a stage."""

    stage: str
    done: int
    total: int


Steps = Generator[Step, None, T]
"""A long computation that can be suspended after each of its steps, and returns a T."""


def run_to_end(steps: Steps[T], progress: Progress) -> T:
    """The result of a computation, without a pause. `progress` receives each step."""
    while True:
        try:
            step = next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
        progress.step(step.stage, step.done, step.total)


class Neighbourhood(Protocol):
    """A set of points in which the nearest ones can be looked up."""

    def nearest(self, queries_m: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices (N, count) of the nearest points of each query (N, 3), nearest first, and squared distances
        (N, count) in m². The set must hold at least `count` points. Every call gives the same to the bit."""
        ...


class NeighbourSearch(Protocol):
    """Prepares points for looking up the nearest ones."""

    def over(self, points_m: NDArray[np.float64]) -> Neighbourhood:
        """The neighbourhood over finite points (M, 3)."""
        ...
