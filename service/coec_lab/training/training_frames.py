"""A frame to learn from, and frames on disk: one npz file per town, written completely or not at all. Separate from
rendering, because training needs neither rays nor scenes. What training does to a frame (cuts, turns, colours), and the
target of its codes, needs no torch.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
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


Floats = NDArray[np.float32]

ZOOM = 1.35
"""At least 1/`ZOOM` of each side is kept."""


def augment(shown: TrainingFrame, height: int, width: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """RGB (height, width, 3), 0 to 255, and the target (height, width): see `target`."""
    bgr, code = _cut(shown, height, width, rng)
    rgb = bgr[:, :, ::-1].astype(np.float32)
    if rng.random() < 0.25:  # a sky as bright as a real sensor sees it
        sky = (code == SKY)[:, :, None]
        rgb = np.where(sky, rng.uniform(120, 255, 3).astype(np.float32) * 0.3 + rng.uniform(120, 255) * 0.7, rgb)
    rgb = _recolour(np.clip(rgb, 0, 255) / np.float32(255), rng)
    if rng.random() < 0.15:
        rgb = np.asarray(cv2.GaussianBlur(rgb, (0, 0), float(rng.uniform(0.4, 1.5))), np.float32)
    if rng.random() < 0.5:
        rgb = rgb + np.float32(10 ** rng.uniform(-2.3, -1.2)) * rng.standard_normal(rgb.shape, dtype=np.float32)
    rgb = np.clip(rgb * np.float32(255), 0, 255).astype(np.float32)
    return rgb, target(code)


def target(code: NDArray[np.uint16]) -> Floats:
    """√(inverse range in 1/m), 0 for the sky, NaN where unknown.

    The root spreads far ranges: 5 m to 50 m are 0.45 to 0.14 instead of 0.2 to 0.02. It keeps the order.
    """
    root = np.sqrt(code.astype(np.float32) / np.float32(65535))
    root[code == SKY] = 0.0
    root[code == 0] = np.nan
    return np.asarray(root, np.float32)


def _cut(
    shown: TrainingFrame, height: int, width: int, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    h, w = shown.code.shape
    zoom = rng.uniform(1.0, ZOOM) if rng.random() < 0.6 else 1.0
    tall, wide = int(h / zoom), int(w / min(zoom * rng.uniform(0.9, 1.1), ZOOM) if zoom > 1.0 else w)
    wide = min(wide, w)
    top, left = int(rng.integers(h - tall + 1)), int(rng.integers(w - wide + 1))
    part = slice(top, top + tall), slice(left, left + wide)
    bgr, code = shown.bgr[part], shown.code[part]
    if rng.random() < 0.5:
        bgr, code = bgr[:, ::-1], code[:, ::-1]
    way = cv2.INTER_AREA if height < tall else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(np.ascontiguousarray(bgr), (width, height), interpolation=way), np.uint8)
    nearest = cv2.resize(np.ascontiguousarray(code), (width, height), interpolation=cv2.INTER_NEAREST)
    return resized, np.asarray(nearest, np.uint16)


def _recolour(rgb: Floats, rng: np.random.Generator) -> Floats:
    """Gamma, tint, saturation, contrast; 0 to 1."""
    if rng.random() < 0.05:
        rgb = rgb[:, :, rng.permutation(3)]
    rgb = np.maximum(rgb, 0) ** np.float32(np.exp(rng.normal(0, 0.25)))
    rgb = rgb * np.exp(rng.normal(0, 0.07, 3)).astype(np.float32)
    grey = rgb.mean(axis=2, keepdims=True)
    saturation = 0.0 if rng.random() < 0.12 else rng.uniform(0.3, 1.4)
    rgb = grey + np.float32(saturation) * (rgb - grey)
    middle = rgb.mean()
    contrast = np.float32(np.exp(rng.normal(0, 0.25)))
    return np.asarray((rgb - middle) * contrast + middle + np.float32(rng.normal(0, 0.06)), np.float32)
