"""The matrix: simulated drives of many scenes, lenses, LiDARs, lights and faults, as data.

Their seeds are beyond those of training, demonstration and tests. What the first round taught (`docs/measured.md`) is
tried on the next round, which has the same kinds of drives with other seeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

FIRST_SEED = 500_001
"""Beyond all seeds that are used for learning or for showing."""
SEEDS, SEEDS_EACH = 3, 2
"""Seeds of a round, and how many of them each kind of drive takes, in turn."""

LENSES = {
    "fisheye": "camera=fisheye700",
    "wide": "camera=pinhole640x400",
    "60deg": "camera=pinhole640x400@60",
    "45deg": "camera=pinhole640x400@45",
    "30deg": "camera=pinhole640x400@30",
}
SCENES = {
    "street": "",
    "street-standing": "speed_mps=0",
    "street-parked": "speed_mps=0&traffic=no",
    "highway": "scene=highway",
    "garage": "scene=garage",
    "garage-standing": "scene=garage&speed_mps=0",
    "room": "scene=room",
    "room-standing": "scene=room&speed_mps=0",
    "room-empty": "scene=room&speed_mps=0&traffic=no",
    "tunnel": "faults=tunnel:0",
    "open-road": "faults=open_road:0",
}
LIGHTS = {"day": "", "night": "faults=night:0", "rain": "faults=rain:0:mmph=25", "low-sun": "faults=low_sun:0"}
FAULTS = {
    "none": "",
    "focal": "intrinsics_off=2",
    "centre": "intrinsics_off=0,0.5,-0.5",
    "rolling": "rolling_shutter_s=0.03",
    "clock": "faults=offset_drift:0-40:seconds=0.04",
    "late": "faults=offset:0:seconds=0.03",
    "no-ego": "faults=no-ego:0",
    "beams": "faults=beams:0:share=0.5",
    "dirt": "faults=dirt:0:share=0.25",
    "step": "faults=step:12:rx=1,ry=-1",
}
"""By name, the words of a `sim:` SOURCE. A step of 1.4° lies in the first of two windows."""

MOVING_MOUNT = ("step",)
"""Faults that change the truth, so that no pose is right all along."""


@dataclass(frozen=True, slots=True)
class MatrixDrive:
    """A kind of drive and its seed. The words are keys of `SCENES`, `LENSES`, `LIGHTS` and `FAULTS`."""

    scene: str
    lens: str
    lidar: str
    light: str
    fault: str
    seed: int

    @property
    def name(self) -> str:
        """Its name: all its words, and the number of its seed."""
        parts = (self.scene, self.lens, self.lidar, self.light, self.fault, f"s{self.seed - FIRST_SEED + 1}")
        return "_".join(parts)

    @property
    def moving_mount(self) -> bool:
        """Whether the truth changes on the way."""
        return self.fault in MOVING_MOUNT

    def source(self, seconds: float, hertz: float, *, depth: bool) -> str:
        """The SOURCE that draws it, with pictures and sweeps at `hertz`, and with exact depth maps if `depth`."""
        parameters = [f"seed={self.seed}", f"seconds={seconds:g}", f"camera_hz={hertz:g}", f"lidar_hz={hertz:g}"]
        parameters += ["ego_hz=20", f"lidar={self.lidar}", *(["depth=yes"] if depth else [])]
        faults = []
        for part in (SCENES[self.scene], LENSES[self.lens], LIGHTS[self.light], FAULTS[self.fault]):
            for word in filter(None, part.split("&")):
                faults.append(word.removeprefix("faults=")) if word.startswith("faults=") else parameters.append(word)
        return "sim:" + "&".join([*parameters, *([f"faults={';'.join(faults)}"] if faults else [])])


KINDS: tuple[tuple[str, str, str, str, str], ...] = (
    # LiDARs, in a street.
    ("street", "fisheye", "64", "day", "none"),
    ("street", "fisheye", "32", "day", "none"),
    ("street", "fisheye", "16", "day", "none"),
    ("street", "wide", "128", "day", "none"),
    ("street", "wide", "raster", "day", "none"),
    ("street", "wide", "rosette", "day", "none"),
    # Lenses.
    ("street", "wide", "64", "day", "none"),
    ("street", "60deg", "64", "day", "none"),
    ("street", "45deg", "128", "day", "none"),
    ("street", "30deg", "128", "day", "none"),
    ("street", "60deg", "raster", "day", "none"),
    # Light and weather.
    ("street", "fisheye", "64", "night", "none"),
    ("street", "wide", "32", "night", "none"),
    ("street", "fisheye", "64", "rain", "none"),
    ("street", "wide", "raster", "rain", "none"),
    ("street", "wide", "64", "low-sun", "none"),
    ("street", "fisheye", "32", "low-sun", "none"),
    # Standing.
    ("street-standing", "fisheye", "64", "day", "none"),
    ("street-parked", "wide", "32", "day", "none"),
    ("room-standing", "wide", "16", "day", "none"),
    ("room-empty", "fisheye", "16", "day", "none"),
    ("garage-standing", "fisheye", "64", "day", "none"),
    # Indoors, on the move.
    ("garage", "fisheye", "64", "day", "none"),
    ("garage", "wide", "32", "day", "none"),
    ("garage", "wide", "rosette", "day", "none"),
    ("room", "fisheye", "32", "day", "none"),
    ("room", "wide", "16", "day", "none"),
    # Little to see.
    ("highway", "wide", "64", "day", "none"),
    ("highway", "60deg", "128", "rain", "none"),
    ("highway", "fisheye", "64", "night", "none"),
    ("tunnel", "fisheye", "64", "day", "none"),
    ("open-road", "wide", "64", "day", "none"),
    # Faults.
    ("street", "wide", "64", "day", "focal"),
    ("street", "fisheye", "64", "day", "centre"),
    ("street", "wide", "64", "day", "rolling"),
    ("street", "fisheye", "64", "day", "clock"),
    ("street", "wide", "32", "day", "late"),
    ("street", "fisheye", "64", "day", "no-ego"),
    ("street", "wide", "64", "day", "beams"),
    ("street", "fisheye", "64", "day", "dirt"),
    ("street", "fisheye", "64", "day", "step"),
    ("street", "wide", "64", "day", "step"),
)
"""Scene, lens, LiDAR, light, fault."""


def drives(number: int) -> tuple[MatrixDrive, ...]:
    """The drives of a round, counted from 1. Every kind with its first seed comes before any kind with its second, so
    that half a run covers all kinds."""
    first = FIRST_SEED + (number - 1) * SEEDS
    return tuple(
        MatrixDrive(*kind, first + (place + turn) % SEEDS)
        for turn in range(SEEDS_EACH)
        for place, kind in enumerate(KINDS)
    )


def selected_drives(number: int, pattern: str | None) -> tuple[MatrixDrive, ...]:
    """The drives of a round whose name matches a shell pattern (`*`, `?`); all for None."""
    return tuple(drive for drive in drives(number) if pattern is None or fnmatchcase(drive.name, pattern))
