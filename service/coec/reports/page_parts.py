"""Parts that the pages of several commands share: blocks made from wire models, and where a page comes from."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
import struct
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from itertools import zip_longest
from math import isfinite, log2
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from coec import __version__
from coec.calibration.figures import FIGURES, OTHER_ADVICE
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import FramePair, Window
from coec.errors import OutputError
from coec.geometry import se3
from coec.io.depth.depth_maps import PRECOMPUTED
from coec.io.depth.model_cards import built_in_cards
from coec.io.serialise import in_degrees
from coec.reports import page
from coec.reports.console import AXIS_NAMES, UNITS
from coec.reports.formatting import number, second, significant, size
from coec.schemas.replies import Intrinsics, Maybe6, MetricReply, Reason, Transform

TONES: Mapping[str, page.Tone] = {
    "accepted": "good",
    "healthy": "good",
    "calibrated": "good",
    "suspect": "unsure",
    "undecided": "unsure",
    "not_accepted": "unsure",
    "degraded": "poor",
    "failed": "bad",
    "miscalibrated": "bad",
    "camera_moved": "bad",
    "lidar_moved": "bad",
}
"""Tones of states and decisions; one that is not listed is neither good nor bad."""

DIGITS = {"deg": 3, "m": 4}
"""Digits after the point: a thousandth of a degree and a tenth of a millimetre are below any σ."""

SHOWN_UNITS = {"deg": "°", "m": "m"}

PLENTY = 4.0
"""A figure this factor better than its limit stands at one end of its margin, one this factor worse at the other."""

CAPTIONS: Mapping[str, tuple[str, str]] = {
    "overlay": (
        "LiDAR points drawn on the camera image at the extrinsic that was checked",
        "Points at the extrinsic that was checked, coloured by range. Where it is right they end where things end.",
    ),
    "first_picture": (
        "LiDAR points drawn on the first camera image of the drive",
        "The first picture, with the points where the workshop's calibration puts them, coloured by range.",
    ),
    "close_ups": (
        "Enlarged parts of the image with the range edges of the LiDAR, at the start and at the result",
        "Close-ups where both extrinsics differ most: range edges should lie on the edges of the image. Above each: "
        "how far the start is off, and σ of the result there.",
    ),
    "residuals": (
        "Map over the image of how well range edges and image edges agree at the result",
        "Where in the image range edges and image edges agree at the result, in degrees and pixels. What all parts "
        "have in common compares with the σ of the result; a single part scatters more.",
    ),
    "lens_residual": (
        "Map over the image of how far the fitted camera model is from the one it stands for",
        "What the fitted camera model misses, in pixels over the image.",
    ),
}
"""Alternative text and caption of a picture by the stem of its file."""


def file_picture(path: Path) -> page.Picture:
    """A picture file with its texts from `CAPTIONS`.

    Raises:
        OutputError: it can no longer be read.
    """
    alt, caption = CAPTIONS[path.stem]
    return page.Picture(read(path), alt, caption)


def read(path: Path) -> bytes:
    """The bytes of a file that was just written.

    Raises:
        OutputError: it can no longer be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise OutputError(f"cannot read {path}, which was just written: {error.strerror}") from error


def axis_value(value: float | None, axis: int, sign: bool = True) -> str:
    """The value of an axis, with the digits of its unit."""
    return number(value, DIGITS[UNITS[axis]], sign)


def axes_table(
    caption: str,
    value_name: str,
    values: Sequence[float | None],
    sigmas: Sequence[float | None],
    labels: Mapping[int, str] | None = None,
    more: Mapping[str, Sequence[str]] | None = None,
) -> page.AxesTable:
    """A table of six axes, deg and m. `labels` replace the values of axes that have none; `more` are further columns by
    head."""
    labels, more = labels or {}, more or {}
    widest = {
        unit: max(
            (abs(value) + (sigma or 0.0) for axis, (value, sigma) in enumerate(zip(values, sigmas, strict=True))
             if value is not None and axis not in labels and UNITS[axis] == unit),
            default=0.0,
        )
        for unit in SHOWN_UNITS
    }  # fmt: skip
    lines = []
    for axis, (value, sigma) in enumerate(zip(values, sigmas, strict=True)):
        unit = UNITS[axis]
        scale = widest[unit] or 1.0
        known = value is not None and axis not in labels
        lines.append(
            page.AxisLine(
                name=AXIS_NAMES[axis],
                value=axis_value(value, axis) if known else labels.get(axis, "not known"),
                sigma=axis_value(sigma, axis, sign=False) if known else "",
                unit=SHOWN_UNITS[unit],
                share=value / scale if known and value is not None else None,
                sigma_share=sigma / scale if known and sigma is not None else None,
                more=tuple(column[axis] for column in more.values()),
            )
        )
    return page.AxesTable(caption, value_name, tuple(lines), tuple(more))


def copies_of(transform: Transform, camera: str, lidar: str, *, warning: str = "") -> page.Copies:
    """A transform in the forms that other programs take. A `warning` is the first line of each, as a comment."""
    T_lidar_camera = se3.inverse(np.array(transform.matrix))
    rows = [list(row) for row in transform.matrix]
    inverse = [[float(value) for value in row] for row in T_lidar_camera]
    x, y, z, w = transform.quaternion_xyzw
    above = f"# {warning}\n" if warning else ""
    return page.Copies(
        (
            page.Copy(
                "T_camera_lidar, 4 × 4",
                f"p_camera = T · p_lidar, metres: from {lidar} to {camera}. The copy has every digit, as JSON.",
                above + _matrix(rows),
                above + json.dumps(rows),
            ),
            page.Copy(
                "Translation and quaternion",
                "The same as x y z (m) and qx qy qz qw, the order of ROS and Eigen's coefficients.",
                above + _matrix((transform.translation_m, (x, y, z, w))),
                above + " ".join(repr(value) for value in (*transform.translation_m, x, y, z, w)),
            ),
            page.Copy(
                "T_lidar_camera, 4 × 4",
                f"The inverse: from {camera} to {lidar}. As JSON.",
                above + _matrix(inverse),
                above + json.dumps(inverse),
            ),
        )
    )


def figures_block(
    caption: str, metrics: Mapping[str, MetricReply], *, deciding: frozenset[str] | None = None
) -> page.Figures:
    """Every figure with its limit, its meaning and, where it fails, what to do; failing ones first. Figures that are
    not among the `deciding` ones (None: all decide) come last, in grey and without advice."""
    lines = [_figure(name, metric, deciding is None or name in deciding) for name, metric in metrics.items()]
    return page.Figures(caption, tuple(sorted(lines, key=lambda line: (not line.decided, line.met is not False))))


def title_of(name: str) -> str:
    """The title of a figure, with its name in documents."""
    known = FIGURES.get(name)
    if known is None:
        return name
    return f"{known.title}, {known.unit} ({name})" if known.unit else f"{known.title} ({name})"


def advice_of(reasons: Sequence[Reason]) -> tuple[str, ...]:
    """What to do about some reasons, each advice once."""
    return tuple(dict.fromkeys(text for reason in reasons if (text := _advice(reason.code))))


def turn_and_shift(correction: Sequence[float | None]) -> str:
    """How far a correction (deg, m) turns and shifts, in words."""
    turn, shift = size(correction[:3]), size(correction[3:])
    text = f"turned by {number(turn, 2)}°"
    return text if not shift else f"{text} and shifted by {number(100.0 * shift, 1)} cm"


def _advice(code: str) -> str:
    if code in FIGURES:
        return FIGURES[code].advice
    if code in CAUSES:
        return CAUSES[code].advice
    return OTHER_ADVICE.get(code, "")


def _figure(name: str, metric: MetricReply, decided: bool) -> page.FigureLine:
    known = FIGURES.get(name)
    met = None if metric.limit is None else metric.passed
    meaning = "" if known is None else known.measures
    if met is False and known is not None and decided:
        meaning = f"{meaning} Here: {known.fails}."
    return page.FigureLine(
        code=name,
        title=name if known is None else known.title,
        value=significant(metric.value),
        unit="" if known is None else known.unit,
        limit="" if metric.limit is None else f"{'≥' if metric.at_least else '≤'} {significant(metric.limit)}",
        met=met,
        margin=_margin(metric),
        meaning=meaning,
        advice=known.advice if met is False and known is not None and decided else "",
        decided=decided,
    )


def _margin(metric: MetricReply) -> float | None:
    if metric.value is None or metric.limit is None or metric.limit <= 0.0:
        return None
    if metric.value <= 0.0:
        return 0.0 if metric.at_least else 1.0
    times = metric.value / metric.limit if metric.at_least else metric.limit / metric.value
    return min(max(0.5 + 0.5 * log2(times) / log2(PLENTY), 0.0), 1.0)


def _matrix(rows: Sequence[Sequence[float]]) -> str:
    return _columns([[f"{value + 0.0:.9f}" for value in row] for row in rows])


def _columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows as lines, with aligned columns."""
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=False)) for row in rows)


def finite_degrees(rad_m: NDArray[np.float64]) -> Maybe6:
    """(6,) radians and metres in degrees and metres, None where there is no figure."""
    return cast("Maybe6", tuple(finite_values(in_degrees(rad_m))))


def finite_values(values: Iterable[float]) -> list[float | None]:
    """The values, None where one is not finite."""
    return [finite_or_none(float(value)) for value in values]


def finite_or_none(value: float) -> float | None:
    """The value, or None where it is not finite."""
    return value if isfinite(value) else None


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

    @classmethod
    def here(cls) -> Provenance:
        """That of a document that this process makes now."""
        return cls(
            command=shlex.join(["coec", *sys.argv[1:]]),
            wall_ns=time.time_ns(),
            versions=versions(),
            machine=f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        )

    def items(self) -> tuple[tuple[str, str], ...]:
        """Names and values for people."""
        versions = ", ".join(f"{package} {number}" for package, number in self.versions.items())
        return (
            ("Command", self.command),
            ("Made", second(self.wall_ns)),
            ("Versions", versions),
            ("On", self.machine),
        )

    def section(self, of: Sequence[tuple[str, str]] = ()) -> page.Section:
        """The last section of a page: what the page is made `of` (names and values; hashes are shown as code), followed
        by these items."""
        items = (*of, *self.items())
        codes = {name for name, _ in items if "sha256" in name or "hash" in name}
        return page.Section("Provenance", (page.Facts(items, frozenset({*codes, "Command"})),))


def depth_items(identity: str) -> tuple[tuple[str, str], ...]:
    """Where depth comes from, by the `depth_identity` of a result: name and sha256 of the network."""
    if identity == PRECOMPUTED:
        return (("Depth", "precomputed: the maps of the source"),)
    name = next((card.name for card in built_in_cards().values() if card.sha256 == identity), "a network of your own")
    return (("Depth network", name), ("Depth network, sha256", identity))


def intrinsics_items(lens: Intrinsics | None) -> tuple[tuple[str, str], ...]:
    """The intrinsics for which an extrinsic holds."""
    if lens is None:
        return ()
    parameters = ", ".join(f"{name} {significant(value, 6)}" for name, value in lens.parameters.items())
    return (
        ("Holds with the intrinsics", f"{lens.model}, {lens.width} × {lens.height} px, {parameters}"),
        *((("Intrinsics, sha256", lens.sha256),) if lens.sha256 else ()),
    )


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
