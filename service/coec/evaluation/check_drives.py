"""Drives on which checks are tried, as data: rigs and places, with seeds from which nothing was learned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

CHECK_PAIRS, CHECKS, PERIOD_S = 6, 5, 5.0
"""Pairs of a check, checks of a drive, and seconds between two: as the monitor is configured unless told otherwise."""

HERTZ = CHECK_PAIRS / PERIOD_S

RIGS = {
    "64-60deg": "lidar=64&camera=pinhole400x240@60",
    "64-fisheye520": "lidar=64&camera=fisheye520&half_view_deg=70",
    "32-100deg": "lidar=32&camera=pinhole600x300@100",
    "32-70deg": "lidar=32&camera=pinhole420x260@70",
}
"""By name, the words of a `sim:` SOURCE. None of these lenses is in the matrix, and nothing was learned from them. Rigs
with the same LiDAR see the same drives, so a sweep is drawn once for all of them."""

PLACES = {
    "highway": "scene=highway",
    "street": "",
    "garage": "scene=garage",
    "street-low-sun": "faults=low_sun:0",
    "highway-rain": "scene=highway&faults=rain:0:mmph=10",
    "street-night": "faults=night:0",
    "room": "scene=room",
    "street-rain": "faults=rain:0:mmph=10",
    "open-road": "faults=open_road:0",
    "tunnel": "faults=tunnel:0",
}
"""Likewise."""

FIRST_SEED = 950_001
"""Beyond all seeds that are used for learning or for showing."""

COMMISSIONED_ON = (("street", 920_001), ("garage", 920_002))
"""Places and seeds of the drives that a rig is commissioned on."""

COMMISSIONED_CHECKS = 3
"""Length of each of these drives, in checks: together 36 pairs, as many as one or two windows of a rig."""


@dataclass(frozen=True, slots=True)
class CheckDrive:
    """A drive of `CHECKS` checks. `rig` and `place` are keys of `RIGS` and `PLACES`."""

    rig: str
    place: str
    seed: int

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.rig}_{self.place}_{self.seed}"

    def source(self, checks: int) -> str:
        """The SOURCE that draws so many checks of it."""
        # A moment longer, so that the last pair is begun.
        seconds = checks * PERIOD_S + 0.5 / HERTZ
        parameters = [f"seed={self.seed}", f"seconds={seconds:g}", f"camera_hz={HERTZ:g}", f"lidar_hz={HERTZ:g}"]
        return "sim:" + "&".join([*parameters, "ego_hz=20", RIGS[self.rig], *filter(None, [PLACES[self.place]])])


def drives(rounds: int, first: int = 1) -> Iterator[tuple[CheckDrive, ...]]:
    """Every place with every rig, `rounds` times from round `first` on, each time with another seed, so that part of a
    run covers them all. Drives that differ only in their lens come together."""
    for turn in range(first - 1, first - 1 + rounds):
        for number, place in enumerate(PLACES):
            for _, rigs in groupby(RIGS, lambda rig: RIGS[rig].partition("&")[0]):
                yield tuple(CheckDrive(rig, place, FIRST_SEED + turn * len(PLACES) + number) for rig in rigs)
