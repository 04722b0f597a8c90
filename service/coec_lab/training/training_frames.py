"""A frame to learn from, and frames on disk: one npz file per town, written completely or not at all. Separate from
rendering, because training needs neither rays nor scenes.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SHAPES: dict[str, tuple[int, int]] = {"round": (192, 192), "wide": (160, 288), "panorama": (128, 416)}
"""(height, width) px by kind: whole fisheyes, common cameras, KITTI's narrow strips. Multiples of 32."""
KINDS: tuple[tuple[str, float], ...] = (("round", 0.4), ("wide", 0.35), ("panorama", 0.25))
"""Kinds with their shares."""
NEAREST_M = 1.0
"""Range whose inverse has the largest code, 65535; nearer surfaces have the same code."""
UNKNOWN, SKY = 0, 1
"""Codes of pixels without a target (own body, outside the lens) and of the sky."""


class TrainingFrame(NamedTuple):
    """A frame to learn from.

    Attributes:
        kind: key of `SHAPES`.
        bgr: (height, width, 3) uint8.
        code: (height, width) uint16, inverse range: 65535 · `NEAREST_M` / range; `SKY`, `UNKNOWN`.
    """

    kind: str
    bgr: NDArray[np.uint8]
    code: NDArray[np.uint16]


def write(folder: Path, seed: int, frames: Iterable[TrainingFrame]) -> Path:
    """Writes `town_<seed>.npz`: for each kind that occurs, the stacked arrays `<kind>_bgr` and `<kind>_code`."""
    by_kind: dict[str, list[TrainingFrame]] = {}
    for frame in frames:
        by_kind.setdefault(frame.kind, []).append(frame)
    arrays = {}
    for kind, shown in by_kind.items():
        arrays[f"{kind}_bgr"] = np.stack([frame.bgr for frame in shown])
        arrays[f"{kind}_code"] = np.stack([frame.code for frame in shown])
    path = path_of(folder, seed)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes the keywords for `allow_pickle`
    return part.rename(path)


def path_of(folder: Path, seed: int) -> Path:
    """Path of the frames of a town."""
    return folder / f"town_{seed}.npz"


def read(path: Path) -> list[TrainingFrame]:
    """The frames of one file."""
    frames = []
    with np.load(path) as arrays:
        for kind in SHAPES:
            if f"{kind}_bgr" in arrays:
                pairs = zip(arrays[f"{kind}_bgr"], arrays[f"{kind}_code"], strict=True)
                frames += [TrainingFrame(kind, bgr, code) for bgr, code in pairs]
    return frames


def towns(folder: Path) -> list[Path]:
    """The files of a folder, in the order of their seeds."""
    return sorted(folder.glob("town_*.npz"), key=lambda path: int(path.stem.removeprefix("town_")))
