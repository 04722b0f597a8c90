"""Model cards: what one has to know about a monocular depth network to feed it and to read its output.

A card is a YAML file beside the network (`midas.onnx` -> `midas.yaml`): either a whole card, or one line that
points to a built-in one, `card: dpt_beit_large_512`. Networks whose file is known are recognised by sha256
and need no YAML. The built-in cards are in the folder `cards`, together with the network of one of them, `street`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from coec.config import describe, load_yaml
from coec.config.model import ConfigModel
from coec.errors import ConfigError, ModelError

Channels = tuple[float, float, float]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Side = Annotated[int, Field(ge=16, le=4096)]

CARDS = Path(__file__).parent / "cards"


class FixedSize(ConfigModel):
    """Every image is stretched to this size, px."""

    height: Side
    width: Side

    def size_for(self, height_px: int, width_px: int) -> tuple[int, int]:  # noqa: ARG002 - as KeepAspect's
        """(height, width) of the network input, px."""
        return self.height, self.width


class KeepAspect(ConfigModel):
    """One side of the image becomes `side` px, the other follows; both are rounded to `multiple` px.

    `fit` names the side: `short`, `long`, or `minimal` for the one that needs the least scaling. These are
    the `lower_bound`, `upper_bound` and `minimal` of MiDaS' `Resize` (isl-org/MiDaS, midas/transforms.py).
    """

    side: Side
    multiple: int = Field(ge=1, le=256)
    fit: Literal["short", "long", "minimal"] = "short"

    def size_for(self, height_px: int, width_px: int) -> tuple[int, int]:
        """(height, width) of the network input for an image of the given size, px."""
        scales = self.side / height_px, self.side / width_px
        match self.fit:
            case "short":
                scale = max(scales)
            case "long":
                scale = min(scales)
            case "minimal":
                scale = min(scales, key=lambda each: abs(1.0 - each))
        return self._round(height_px * scale), self._round(width_px * scale)

    def _round(self, length_px: float) -> int:
        return max(self.multiple, round(length_px / self.multiple) * self.multiple)


class CardInput(ConfigModel):
    """From an image to the input tensor, (1, 3, height, width) float32: (value · scale - mean) / std."""

    name: str | None = Field(default=None, description="name of the input tensor; the only one when not given")
    size: FixedSize | KeepAspect
    colour_order: Literal["rgb", "bgr"] = "rgb"
    scale: float = Field(gt=0, description="factor on pixel values 0 to 255")
    mean: Channels = Field(default=(0.0, 0.0, 0.0), description="in colour order, after scaling")
    std: Channels = Field(default=(1.0, 1.0, 1.0), description="in colour order, after scaling")
    interpolation: Literal["area", "linear", "cubic"] = Field(
        default="area", description="`area` averages when shrinking and is linear when enlarging"
    )

    @model_validator(mode="after")
    def _std_positive(self) -> CardInput:
        if min(self.std) <= 0:
            raise ValueError("std must be positive")
        return self


class CardOutput(ConfigModel):
    """What the output tensor means. Its values are used unchanged, so that this describes them and converts
    nothing."""

    name: str | None = Field(default=None, description="name of the output tensor; the only one when not given")
    kind: Literal["inverse_depth", "depth", "metric_depth"]
    unit_m: float | None = Field(default=None, gt=0, description="metres per unit, for `metric_depth`")

    @model_validator(mode="after")
    def _unit_where_metric(self) -> CardOutput:
        if (self.kind == "metric_depth") != (self.unit_m is not None):
            raise ValueError("unit_m belongs to metric_depth, and to it alone")
        return self


class ModelCard(ConfigModel):
    """A depth network. `file` is the usual file name; `sha256` is that of the one file on which this card was
    measured."""

    name: str = Field(pattern=r"^[a-z0-9_]{1,64}$")
    file: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.-]+\.onnx$")
    input: CardInput
    output: CardOutput
    licence: str = Field(min_length=1, description="of the weights: SPDX identifier, or what the authors wrote")
    sha256: Sha256 | None = None
    source: str = Field(min_length=1, description="where the network and these numbers come from")
    obtain: str = Field(default="its authors", min_length=1, description="how somebody gets the file, in a few words")
    rank_correlation: dict[str, Annotated[float, Field(ge=-1, le=1)]] = Field(
        default_factory=dict,
        description="Spearman's, of the output with inverse LiDAR range, median of the frames, by recording",
    )


class _Reference(ConfigModel):
    card: str


@cache
def built_in_cards() -> dict[str, ModelCard]:
    """The cards that come with the package, by name."""
    cards = [read_card(path) for path in sorted(CARDS.glob("*.yaml"))]
    return {card.name: card for card in cards}


def list_models() -> list[ModelCard]:
    """The built-in cards, sorted by name."""
    return [card for _, card in sorted(built_in_cards().items())]


def find_card(network: Path, sha256: str, named: ModelCard | None = None) -> ModelCard:
    """The card of a network file: the YAML beside it, else the built-in card of the requested name, else the
    built-in card with that sha256.

    Args:
        network: the ONNX file.
        sha256: of that file, hexadecimal.
        named: the built-in card by whose name the file was found, if it was.

    Raises:
        ModelError: there is no card, the one beside the file is not valid, or it belongs to another file.
    """
    sibling = network.with_suffix(".yaml")
    recognised = [card for card in built_in_cards().values() if card.sha256 == sha256]
    if sibling.is_file():
        card = read_card(sibling)
    elif named is not None:
        card = named
    elif recognised:
        card = recognised[0]
    else:
        raise ModelError(
            f"{network} (sha256 {sha256}) is not known by its sha256 and has no model card: write one to "
            f"{sibling}; where a "
            "built-in card fits, the line `card: NAME` is enough, with NAME one of "
            f"{', '.join(built_in_cards())}"
        )
    if card.sha256 is not None and card.sha256 != sha256:
        raise ModelError(
            f"{network} has sha256 {sha256}, but its card {card.name} is for {card.sha256}: "
            f"restore the network file, or write a card for this one to {sibling}"
        )
    return card


def read_card(path: Path) -> ModelCard:
    """The card in a YAML file: a whole one, or `card: <built-in name>`.

    Raises:
        ModelError: unreadable, not YAML, unknown key or built-in name, value out of range; names each place.
    """
    document = _mapping(path)
    try:
        if "card" not in document:
            return ModelCard.model_validate(document)
        name = _Reference.model_validate(document).card
    except ValidationError as error:
        raise ModelError(f"model card {path}: {describe(error)}") from error
    if name not in built_in_cards():
        raise ModelError(f"model card {path}: there is no built-in card {name!r}; known: {', '.join(built_in_cards())}")
    return built_in_cards()[name]


def _mapping(path: Path) -> dict[str, Any]:
    try:
        document = load_yaml(path)
    except ConfigError as error:
        raise ModelError(f"model card: {error}") from error
    if not isinstance(document, dict):
        raise ModelError(f"model card {path}: expected a mapping at the top, found {type(document).__name__}")
    return document
