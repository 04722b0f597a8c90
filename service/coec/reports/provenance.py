"""Where a result comes from: its inputs, the software, the time and the command, so that anybody can repeat it."""

from __future__ import annotations

import hashlib
import platform
import shlex
import struct
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version

from coec import __version__
from coec.calibration.types import FramePair, Window
from coec.io.depth.depth_maps import PRECOMPUTED
from coec.io.depth.model_cards import built_in_cards
from coec.reports.formatting import second
from coec.reports.page import Facts, Section

CALCULATING = ("numpy", "numba", "nlopt", "onnxruntime")
"""Packages whose code takes part in a decision."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """By what, when and how a document was made.

    Attributes:
        command: as it was typed.
        wall_ns: wall clock, ns since 1970.
        versions: by package, `coec` first.
        machine: system and processor.
    """

    command: str
    wall_ns: int
    versions: dict[str, str]
    machine: str

    def items(self) -> tuple[tuple[str, str], ...]:
        """Names and values for people."""
        versions = ", ".join(f"{package} {number}" for package, number in self.versions.items())
        return (
            ("Command", self.command),
            ("Made", second(self.wall_ns)),
            ("Versions", versions),
            ("On", self.machine),
        )

    def section(self, of: Sequence[tuple[str, str]] = ()) -> Section:
        """The last section of a page: what the page is made `of` (names and values; hashes are shown as code), followed
        by these items."""
        items = (*of, *self.items())
        codes = {name for name, _ in items if "sha256" in name or "hash" in name}
        return Section("Provenance", (Facts(items, frozenset({*codes, "Command"})),))


def here() -> Provenance:
    """Provenance of a document that this process makes now."""
    command = shlex.join(["coec", *sys.argv[1:]])
    return Provenance(
        command,
        time.time_ns(),
        versions(),
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    )


def depth_items(identity: str) -> tuple[tuple[str, str], ...]:
    """Where depth comes from, by the `depth_identity` of a result: name and sha256 of the network."""
    if identity == PRECOMPUTED:
        return (("Depth", "precomputed: the maps of the source"),)
    name = next((card.name for card in built_in_cards().values() if card.sha256 == identity), "a network of your own")
    return (("Depth network", name), ("Depth network, sha256", identity))


def content_hash(window: Window) -> str:
    """sha256 (hexadecimal) of the content of a window: every image, every point, every stamp, in their order. It is the
    same wherever the window was read from."""
    digest = hashlib.sha256()
    for pair in window.pairs:
        for part in _parts(pair):
            digest.update(part)
    return digest.hexdigest()


def _parts(pair: FramePair) -> tuple[bytes, ...]:
    stamps = struct.pack("<qq", pair.camera.stamp_ns, pair.lidar.stamp_ns)
    return stamps, bytes(pair.camera.image.data), pair.lidar.xyz_m.tobytes()


@cache
def versions() -> dict[str, str]:
    """Versions of everything that takes part in a decision, by package, `coec` first."""
    return {"coec": __version__, **{package: version(package) for package in CALCULATING}}
