"""Frames on disk: one npz file per town, written completely or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from coec.simulation.training.shown import SHAPES, TrainingFrame


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
