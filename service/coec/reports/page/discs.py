"""Plots in polar coordinates as SVG: discs that show directions, or errors with their directions. As with `charts`,
colours follow the page, and equal figures give equal bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DISC_SIDE_PX = 344
"""Width and height of a drawing, px: a phone shows it without shrinking it."""

DISC_RADIUS_PX = 132.0
"""Radius of the disc, px; labels stand around it."""


@dataclass(frozen=True, slots=True)
class DotKind:
    """What a dot stands for.

    Attributes:
        tone: its colour, as in `blocks.Tone`.
        shape: its shape, which tells kinds apart without colour.
        full: whether it is filled or hollow.
    """

    name: str
    tone: str
    shape: Literal["circle", "cross"]
    full: bool


@dataclass(frozen=True, slots=True)
class Dot:
    """A dot right of and above the centre, as shares of the radius; `told` is shown when a reader points at it."""

    right: float
    up: float
    kind: DotKind
    description: str


@dataclass(frozen=True, slots=True)
class Ring:
    """A ring about the centre, at a share of the radius. `goal`: what lies within is good."""

    share: float
    label: str
    goal: bool = False


@dataclass(frozen=True, slots=True)
class Disc:
    """A plot.

    Attributes:
        told: what the plot shows, in a sentence, for readers who cannot see it.
        compass: labels at the right, at the top, at the left and at the bottom.
        rings: inside the rim; the rim itself has no label.
        dots: later ones lie on top.
    """

    title: str
    description: str
    compass: tuple[str, str, str, str]
    rings: tuple[Ring, ...]
    dots: tuple[Dot, ...]


def dot_position(dot: Dot) -> tuple[float, float]:
    """Place of a dot in the drawing, px from its upper left corner."""
    return round(DISC_SIDE_PX / 2 + DISC_RADIUS_PX * dot.right, 1), round(DISC_SIDE_PX / 2 - DISC_RADIUS_PX * dot.up, 1)
