"""Images between their first look and their second."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration import solver
from coec.calibration.solver import CachedImages
from coec.calibration.types import CameraFrame


@dataclass(eq=False)
class Counted:
    """Decodes frames that say their grey value, and counts."""

    of_frame: Counter[int] = field(default_factory=Counter)

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        self.of_frame[id(frame)] += 1
        return np.full((4, 5), cast(Any, frame).value, np.uint8)


@dataclass(frozen=True, eq=False)
class Frame:
    value: int


def test_an_image_is_decoded_once_for_both_observations_and_then_forgotten() -> None:
    reader, frames = Counted(), [cast(CameraFrame, Frame(value)) for value in (7, 9)]
    once = CachedImages(reader)
    first = [once.first(frame) for frame in frames]
    second = [once.grey(frame) for frame in frames]
    assert [int(grey[0, 0]) for grey in second] == [7, 9]
    assert all(a is b for a, b in zip(first, second, strict=True))
    assert set(reader.of_frame.values()) == {1}
    once.grey(frames[0])
    assert reader.of_frame[id(frames[0])] == 2


def test_no_more_is_retained_than_may_be_and_what_goes_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, frames = Counted(), [cast(CameraFrame, Frame(value)) for value in range(3)]
    monkeypatch.setattr(solver, "MAX_CACHED_BYTES", 2 * 20)
    once = CachedImages(reader)
    for frame in frames:
        once.first(frame)
    for frame in frames:
        once.grey(frame)
    assert [reader.of_frame[id(frame)] for frame in frames] == [1, 1, 2]
    for frame in frames[:2]:
        once.first(frame)
    once.grey(frames[0])
    once.grey(frames[1])
    assert [reader.of_frame[id(frame)] for frame in frames[:2]] == [2, 2]
