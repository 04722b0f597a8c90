"""Sources of depth maps: a network, or maps that came with the frames."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from pathlib import Path

from coec.adapters.depth.model_cards import CARDS, ModelCard, built_in_cards, find_card
from coec.adapters.files.home import from_home
from coec.adapters.frames.incoming import Refusal
from coec.adapters.images.codec import decode_depth
from coec.calibration.ports import DepthModel
from coec.calibration.types import CameraFrame, DepthMap
from coec.config import DepthConfig, LimitsConfig
from coec.errors import DecodeError, ModelError, permission_denied

STEREO = "stereo"
"""Value of `DepthConfig.model` that stands for the maps that come with the frames."""

PRECOMPUTED = "precomputed"
"""Identity of depth that came with the frames."""


class PrecomputedDepth:
    """Depth maps that came with the frames. Implements `DepthModel`."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits

    @property
    def identity(self) -> str:
        """Always `precomputed`: the maps themselves are in the window."""
        return PRECOMPUTED

    def infer(self, frame: CameraFrame) -> DepthMap:
        """The map of the frame, (h, w) float32, NaN for code 0.

        Raises:
            DecodeError: `depth_missing`, or the map cannot be decoded.
        """
        if frame.depth is None:
            raise DecodeError(
                Refusal.DEPTH_MISSING,
                f"the frame at {frame.stamp_ns} ns carries no depth map: use a source that has them, or a "
                "depth network",
            )
        return DepthMap(decode_depth(frame.depth, self._limits))


class CachedDepth:
    """Keeps the latest maps of another `DepthModel`, by the content of the frame. One caller at a time.

    So depth that was inferred while a slice was open need not be inferred again at its end.
    """

    def __init__(self, model: DepthModel, entries: int) -> None:
        """`entries` maps are kept; the least recently used one is dropped first."""
        if entries < 1:
            raise ValueError(f"entries must be at least 1, got {entries}")
        self._model = model
        self._entries = entries
        self._maps: OrderedDict[bytes, DepthMap] = OrderedDict()

    @property
    def identity(self) -> str:
        """Identity of the wrapped model."""
        return self._model.identity

    def infer(self, frame: CameraFrame) -> DepthMap:
        """The wrapped model's map of the frame; failures are not kept.

        Raises:
            DecodeError: as the wrapped model does.
        """
        key = _content_key(frame)
        known = self._maps.get(key)
        if known is None:
            known = self._model.infer(frame)
            self._maps[key] = known
            if len(self._maps) > self._entries:
                self._maps.popitem(last=False)
        self._maps.move_to_end(key)
        return known


def open_depth(config: DepthConfig, limits: LimitsConfig) -> DepthModel:
    """The depth model that a configuration names: `stereo`, an ONNX file, or the name of a built-in card.

    The file of a built-in card is searched in `models_folder()`, then among those that come with the package.

    Raises:
        ModelError: no such file or name, no card for it, a damaged network, or one that does not match its
            card.
    """
    # Imported here because the runtime takes 20 MB, and the service imports this module but opens no network.
    from coec.adapters.depth.onnx_network import OnnxDepth, file_identity

    if config.model == STEREO:
        return PrecomputedDepth(limits)
    named = built_in_cards().get(config.model)
    path = _file_of(named) if named is not None else from_home(config.model)
    if path.parent.is_dir() and not os.access(path.parent, os.X_OK):
        raise ModelError(f"depth network {path}: {permission_denied(path, 'r')}")
    if not os.path.isfile(path):  # noqa: PTH113  of a folder that may not be searched, pathlib raises an error
        raise ModelError(
            f"there is no depth network {path}: give an ONNX file, `{STEREO}` for the maps that come with "
            f"the frames, or the name of a network in {models_folder()}: {', '.join(built_in_cards())}"
        )
    own, identity = file_identity(path)
    card = find_card(path, own, named)
    return OnnxDepth(path, card, config.providers, config.threads, limits, identity)


def models_folder() -> Path:
    """Folder in which networks are searched by name: `coec/models` in $XDG_DATA_HOME, by default ~/.local/share."""
    base = os.environ.get("XDG_DATA_HOME", "")
    return (Path(base) if base else from_home("~/.local/share")) / "coec" / "models"


def _file_of(card: ModelCard) -> Path:
    """`<name>.onnx` in the folder of networks, else the card's usual file name there, else the file that comes with the
    package. If none exists, the first of these paths."""
    name = f"{card.name}.onnx"
    places = [models_folder() / name, models_folder() / (card.file or name), CARDS / name]
    return next((path for path in places if os.path.isfile(path)), places[0])  # noqa: PTH113  as above


def _content_key(frame: CameraFrame) -> bytes:
    digest = hashlib.sha256()
    for image in (frame.image, frame.depth):
        if image is not None:
            # Lengths first, so that two images one after the other differ from one long one.
            digest.update(f"{image.format} {image.width} {image.height} {len(image.data)} ".encode())
            digest.update(image.data)
    return digest.digest()
