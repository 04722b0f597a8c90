"""Sources of depth maps: where the files of known networks are on this machine and how one is added, a network that is
opened by name or file, or maps that came with the frames. The inference library is imported when a network is
opened or its file is identified, never with this module.
"""

import hashlib
import os
import shutil
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

from coec.calibration.types import CameraFrame, DepthMap, DepthModel
from coec.config import DepthConfig, LimitsConfig
from coec.errors import DecodeError, ModelError, OutputError, UsageError, permission_denied
from coec.io import storage
from coec.io.depth.model_cards import CARDS, ModelCard, built_in_cards, find_card
from coec.io.frame_validation import Refusal
from coec.io.images import decode_depth
from coec.io.user_files import expand_home

OWN_NETWORKS = "docs/own-network.md"


def models_folder() -> Path:
    """Folder in which networks are searched by name: `coec/models` in $XDG_DATA_HOME, by default ~/.local/share."""
    base = os.environ.get("XDG_DATA_HOME", "")
    return (Path(base) if base else expand_home("~/.local/share")) / "coec" / "models"


def candidate_paths(card: ModelCard) -> tuple[Path, ...]:
    """The paths at which the file of a network is looked for, in this order: `<name>.onnx` in the folder of networks,
    the card's usual file name there, and the files that come with the package."""
    name = f"{card.name}.onnx"
    folder = models_folder()
    return tuple(dict.fromkeys((folder / name, folder / (card.file or name), CARDS / name)))


def network_file(card: ModelCard) -> Path | None:
    """The file of a network on this machine; None if it is at none of the places."""
    # Of a path below a folder that may not be searched, pathlib raises an error.
    return next((path for path in candidate_paths(card) if os.path.isfile(path)), None)  # noqa: PTH113


def absence_text(card: ModelCard) -> str:
    """What to do about a known network whose file is absent: where it was looked for, where it comes from."""
    return (
        f"the file of the depth network {card.name} is not on this machine: it was looked for as "
        f"{', '.join(str(path) for path in candidate_paths(card)[:-1])}. It comes from: {card.obtain}. "
        "`coec models add FILE` puts it there; a path to an ONNX file can be given instead of the name"
    )


def add_network(file: Path, name: str | None, *, force: bool) -> tuple[ModelCard, Path, bool]:
    """Copies the file of a known network to where it is looked for, atomically and readable for everybody.

    The network is recognised by its sha256. A card without one fits every export of its network: then the file's name
    or `name` says which it is, and the network is opened and run once as its card says.

    Returns:
        Its card, where it is now, and whether it was copied: False if the same file is there already.

    Raises:
        ModelError: the file is absent, of no known network, does not fit its card, or has its weights in other files.
        UsageError: there is no network called `name`.
        OutputError: another file is there and `force` is False, or it cannot be written.
    """
    from coec.io.depth.onnx_network import OnnxDepth, file_identity  # the runtime takes 20 MB

    if not file.is_file():
        raise ModelError(f"there is no file {file}: name the ONNX file of a network")
    digest, identity = file_identity(file)
    card = _card_of(file, digest, name)
    if identity != digest:
        raise ModelError(
            f"{file} has its weights in other files beside it, which the copy would not find: write it as one file "
            "(Python: `onnx.save(onnx.load(FILE), OTHER)`), or name it by its path (--depth, calibration.depth.model)"
        )
    OnnxDepth(file, card, ("cpu",), 1, LimitsConfig(), identity)
    place = candidate_paths(card)[0]
    present = network_file(card)
    if present is not None and file_identity(present)[0] == digest:
        return card, present, False
    if place.is_file() and not force:
        raise OutputError(f"{place} is there already and holds another file: --force replaces it")
    _copy(file, place)
    return card, place, True


def _card_of(file: Path, digest: str, name: str | None) -> ModelCard:
    cards = built_in_cards()
    if name is not None and name not in cards:
        raise UsageError(f"--as {name}: there is no built-in card of this name; known: {', '.join(cards)}")
    recognised = next((card for card in cards.values() if card.sha256 == digest), None)
    named = cards.get(name or file.stem) or next((card for card in cards.values() if card.file == file.name), None)
    card = recognised if name is None and recognised is not None else named
    if card is None:
        open_cards = ", ".join(card.name for card in cards.values() if card.sha256 is None)
        raise ModelError(
            f"{file} (sha256 {digest}) is none of the known networks. If it is an export of one of these, say which "
            f"with --as: {open_cards}. Your own network needs no place here: write a model card beside it, and name it "
            f"by its path ({OWN_NETWORKS})"
        )
    if card.sha256 not in (None, digest):
        raise ModelError(
            f"{file} has sha256 {digest}, and the network {card.name} has {card.sha256}: it is another file, or a "
            f"damaged one. Another export needs a model card of its own ({OWN_NETWORKS})"
        )
    return card


def _copy(file: Path, place: Path) -> None:
    part = place.with_name(f"{place.name}.part")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with file.open("rb") as source, os.fdopen(storage.create(part, 0o644), "wb") as target:
            shutil.copyfileobj(source, target, 2**20)
            # A service that runs as another user reads it, whatever the umask of this one is.
            os.fchmod(target.fileno(), 0o644)
            storage.publish(target, part, place)
    except OSError as error:
        raise OutputError(f"cannot write {place}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


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

    The file of a built-in card is searched where `coec models` puts it.

    Raises:
        ModelError: no such file or name, no card for it, a damaged network, or one that does not match its
            card.
    """
    # Imported here because the runtime takes 20 MB, and the service imports this module but opens no network.
    from coec.io.depth.onnx_network import OnnxDepth, file_identity

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
