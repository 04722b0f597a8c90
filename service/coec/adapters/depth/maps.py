"""Sources of depth maps: a network, or maps that came with the frames."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict

from coec.adapters.depth.model_cards import built_in_cards, find_card
from coec.adapters.depth.network_files import absence_text, candidate_paths, network_file
from coec.adapters.files.home import expand_home
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

    The file of a built-in card is searched at `network_files.places_of`.

    Raises:
        ModelError: no such file or name, no card for it, a damaged network, or one that does not match its
            card.
    """
    # Imported here because the runtime takes 20 MB, and the service imports this module but opens no network.
    from coec.adapters.depth.onnx_network import OnnxDepth, file_identity

    if config.model == STEREO:
        return PrecomputedDepth(limits)
    named = built_in_cards().get(config.model)
    places = (expand_home(config.model),) if named is None else candidate_paths(named)
    # Of a path below a folder that may not be searched, pathlib raises an error.
    path = next((place for place in places if os.path.isfile(place)), None)  # noqa: PTH113
    if path is None:
        for place in places:
            if os.path.isdir(place.parent) and not os.access(place.parent, os.X_OK):  # noqa: PTH112
                raise ModelError(f"depth network {place}: {permission_denied(place, 'r')}")
        if named is not None:
            raise ModelError(absence_text(named))
        present = [card.name for card in built_in_cards().values() if network_file(card) is not None]
        raise ModelError(
            f"there is no depth network {places[0]}: give an ONNX file, `{STEREO}` for the maps that come with the "
            f"frames, or the name of a network whose file is on this machine: {', '.join(present)}. "
            "`coec models` lists all, and where the others come from"
        )
    own, identity = file_identity(path)
    card = find_card(path, own, named)
    return OnnxDepth(path, card, config.providers, config.threads, limits, identity)


def _content_key(frame: CameraFrame) -> bytes:
    digest = hashlib.sha256()
    for image in (frame.image, frame.depth):
        if image is not None:
            # Lengths first, so that two images one after the other differ from one long one.
            digest.update(f"{image.format} {image.width} {image.height} {len(image.data)} ".encode())
            digest.update(image.data)
    return digest.digest()
