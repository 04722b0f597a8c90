"""Plots in polar coordinates as SVG: discs on which directions lie, or errors with their directions. As with `charts`,
their colours follow the page and equal figures give equal bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SIDE = 344
"""Width and height of a drawing, px: what a phone shows without making it smaller."""

RADIUS = 132.0
"""Of the disc, px: labels stand around it."""


@dataclass(frozen=True, slots=True)
class DotKind:
    """What a dot stands for.

    Attributes:
        tone: its colour, as in `blocks.Tone`.
        shape: told without the colour, too.
        full: or hollow.
    """

    name: str
    tone: str
    shape: Literal["circle", "cross"]
    full: bool


@dataclass(frozen=True, slots=True)
class Dot:
    """Right and up of the centre, as shares of the radius; `told` is shown by who points at it."""

    right: float
    up: float
    kind: DotKind
    told: str


@dataclass(frozen=True, slots=True)
class Ring:
    """About the centre, at a share of the radius. `goal`: what lies within is good."""

    share: float
    label: str
    goal: bool = False


@dataclass(frozen=True, slots=True)
class Disc:
    """A plot.

    Attributes:
        told: what is to be seen, in a sentence, for who does not see it.
        compass: what stands at the right, above, at the left and below.
        rings: inside of the rim, which has no label.
        dots: the last ones lie on top.
    """

    title: str
    told: str
    compass: tuple[str, str, str, str]
    rings: tuple[Ring, ...]
    dots: tuple[Dot, ...]


def place(dot: Dot) -> tuple[float, float]:
    """Of a dot in the drawing, px from its upper left corner."""
    return round(SIDE / 2 + RADIUS * dot.right, 1), round(SIDE / 2 - RADIUS * dot.up, 1)
