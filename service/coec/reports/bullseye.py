"""Discs that show where searches began and where they ended: the places of points, and the discs of a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees

import numpy as np
from numpy.typing import NDArray

from coec.evaluation.statistics import HIT_RAD, SolveOutcome
from coec.reports.page import Disc, Discs, Dot, DotKind, Ring
from coec.reports.page.words import number

HIT_DEG = degrees(HIT_RAD)

RIMS_DEG = (1.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 180.0)
"""Radii of the target: the smallest that holds 95 % of the ends is taken, and ends beyond it are drawn on its rim. One
degree is twice the limit of a hit."""

LATITUDES_DEG = (45.0, 90.0, 135.0)
"""Rings on the disc of directions, from +z."""

QUARTERS = (0.25, 0.5, 0.75)
"""Rings on the target, shares of its rim."""

CLEAR = 0.12
"""A ring of the target that is closer than this to the ring of a hit is left out, so that labels do not overlap."""

KINDS: Mapping[tuple[bool, bool], DotKind] = {
    (True, True): DotKind("hits, accepted", "good", "circle", full=True),
    (True, False): DotKind("hits, refused", "unsure", "circle", full=False),
    (False, False): DotKind("misses, refused", "none", "cross", full=False),
    (False, True): DotKind("misses, accepted", "bad", "cross", full=True),
}
"""By hit and accepted; the worst come last, so that they are drawn on top."""

Places = NDArray[np.float64]
"""(n, 2) angle, radians from the right counter-clockwise, and radius."""


def start_places(unit: NDArray[np.float64]) -> Places:
    """Places of directions (n, 3), unit vectors in camera axes, on an equal-area disc of radius 1 (Lambert): the centre
    is +z (roll), the rim -z, the middle ring perpendicular to z."""
    from_z = np.arccos(np.clip(unit[:, 2], -1.0, 1.0))
    return np.column_stack([np.arctan2(unit[:, 1], unit[:, 0]), np.sin(from_z / 2.0)])


def latitude_radius(from_z_deg: float) -> float:
    """Radius of a ring on the disc of `start_places`."""
    return float(np.sin(np.radians(from_z_deg) / 2.0))


def end_places(outcomes: Sequence[SolveOutcome], rim_deg: float) -> Places:
    """Places of ends on the target, degrees from the reference: yaw to the right and pitch upwards, as the picture
    moves; ends beyond the rim lie on it."""
    errors = np.degrees(np.array([outcome.error[:3] for outcome in outcomes]))
    angle_deg = np.linalg.norm(errors, axis=1)
    return np.column_stack([np.arctan2(errors[:, 0], errors[:, 1]), np.minimum(angle_deg, rim_deg)])


def rim_of(outcomes: Sequence[SolveOutcome]) -> float:
    """The radius of the target, degrees, see `RIMS_DEG`."""
    p95_deg = np.quantile(np.degrees([outcome.rotation_rad for outcome in outcomes]), 0.95)
    return next(rim for rim in RIMS_DEG if p95_deg <= rim)


def bullseye(methods: Mapping[str, Sequence[SolveOutcome]], directions: Mapping[str, NDArray[np.float64]]) -> Discs:
    """For each method, a disc of its starts by each of `directions` (title, (n, 3) unit vectors in camera axes), and a
    target of its ends. All targets have the radius of the worst method. A single method may have an empty name."""
    rim_deg = max(rim_of(outcomes) for outcomes in methods.values())
    discs = []
    for method, outcomes in methods.items():
        of = f"{method}: " if method else ""
        discs += [_starts(f"{of}{name}", unit, outcomes) for name, unit in directions.items()]
        discs.append(_target(f"{of}Where they ended", outcomes, rim_deg))
    every = [outcome for outcomes in methods.values() for outcome in outcomes]
    counts = {kind: sum((one.hit, one.accepted) == key for one in every) for key, kind in KINDS.items()}
    return Discs(tuple(discs), tuple((kind, f"{kind.name}: {count}") for kind, count in counts.items()))


def _starts(title: str, unit: NDArray[np.float64], outcomes: Sequence[SolveOutcome]) -> Disc:
    rings = tuple(Ring(latitude_radius(from_z_deg), f"{from_z_deg:g}°") for from_z_deg in LATITUDES_DEG)
    missed = sum(not outcome.hit for outcome in outcomes)
    description = (
        f"{len(outcomes)} directions, of which {missed} led to a miss; the centre looks along +z, the rim along −z"
    )
    return Disc(title, description, ("+x", "+y", "−x", "−y"), rings, _dots(start_places(unit), outcomes))


def _target(title: str, outcomes: Sequence[SolveOutcome], rim_deg: float) -> Disc:
    goal = HIT_DEG / rim_deg
    others = (Ring(share, f"{share * rim_deg:g}°") for share in QUARTERS if abs(share - goal) >= CLEAR)
    rings = (*others, Ring(goal, f"a hit: {HIT_DEG:g}°", goal=True))
    places = end_places(outcomes, rim_deg)
    places[:, 1] /= rim_deg
    hits = sum(outcome.hit for outcome in outcomes)
    description = (
        f"{hits} of {len(outcomes)} lie within {HIT_DEG:g}° of the reference; the rim is {rim_deg:g}° and more"
    )
    return Disc(
        f"{title} (rim: {rim_deg:g}° and more)", description, ("yaw", "pitch", "", ""), rings, _dots(places, outcomes)
    )


def _dots(places: Places, outcomes: Sequence[SolveOutcome]) -> tuple[Dot, ...]:
    order = list(KINDS)
    dots = [
        (
            order.index((outcome.hit, outcome.accepted)),
            Dot(
                float(radius * np.cos(angle)),
                float(radius * np.sin(angle)),
                KINDS[outcome.hit, outcome.accepted],
                f"start {index}: ends {number(degrees(outcome.rotation_rad), 2)}° off",
            ),
        )
        for index, ((angle, radius), outcome) in enumerate(zip(places.tolist(), outcomes, strict=True))
    ]
    return tuple(dot for _, dot in sorted(dots, key=lambda item: item[0]))
