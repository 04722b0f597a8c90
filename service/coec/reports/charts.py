"""Plots as SVG: charts with axes, ticks at round numbers, and discs (polar plots). The geometry is calculated here;
the templates write the markup.

A chart is drawn twice, for a wide and for a narrow page, each at a size at which its letters are legible. The style
sheet shows the one that fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import Literal

STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Distance between two ticks of a linear axis, times a power of ten."""

LOG_STEPS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0))
"""Ticks within a decade of a logarithmic axis, the sparsest choice first."""

LOG_ENOUGH = 3
"""Fewest ticks of a logarithmic axis, if its decades allow."""


def linear_ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between the two ends: as many as possible, but at most `most` (2 or more)."""
    if not (isfinite(low) and isfinite(high)) or high <= low:
        return [low]
    rough = (high - low) / most
    decade = 10.0 ** floor(log10(rough))
    for step in (factor * decade * scale for scale in (1.0, 10.0) for factor in STEPS):
        first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
        if last - first + 1 <= most:
            return [round(number * step, 12) for number in range(first, last + 1)]
    return [low, high]


def logarithmic_ticks(low: float, high: float) -> list[float]:
    """Round numbers between the two ends, which must be above zero."""
    values: list[float] = []
    for steps in LOG_STEPS:
        values = [
            step * 10.0**decade
            for decade in range(floor(log10(low)), ceil(log10(high)) + 1)
            for step in steps
            if low * (1 - 1e-9) <= step * 10.0**decade <= high * (1 + 1e-9)
        ]
        if len(values) >= LOG_ENOUGH:
            return values
    return values


def tick_label(value: float) -> str:
    """A number in its shortest form, with a true minus."""
    return f"{value:g}".replace("-", "−")


Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Series:
    """Points in the order of x; the line is broken where y is not finite.

    Attributes:
        shape: `steps` hold a value until the next, `points` are not joined, `dotted` is a line that is not measured.
        band: (x, low, high) on the same axes, drawn under the line; empty for none.
    """

    name: str
    points: Sequence[Point]
    shape: Literal["line", "steps", "points", "dotted"] = "line"
    band: Sequence[tuple[float, float, float]] = ()


@dataclass(frozen=True, slots=True)
class Ground:
    """A state that holds from one x to another, shown as the background colour; `tone` as in `page.Tone`."""

    begin: float
    end: float
    tone: str
    name: str


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened at an x."""

    at: float
    name: str


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit on y."""

    at: float
    name: str


@dataclass(frozen=True, slots=True)
class Chart:
    """A plot with its axes.

    Attributes:
        description: what the plot shows, in a sentence, for readers who cannot see it.
        log_y: whether y is logarithmic; then values at or below zero are not drawn.
        x_ticks: ticks with their labels, to replace round numbers.
        from_zero: y begins at zero.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    description: str
    grounds: tuple[Ground, ...] = ()
    marks: tuple[Mark, ...] = ()
    limits: tuple[Limit, ...] = ()
    log_y: bool = False
    log_x: bool = False
    x_ticks: tuple[tuple[float, str], ...] = ()
    from_zero: bool = False


@dataclass(frozen=True, slots=True)
class Size:
    """Size of a drawing, px, and its most ticks per axis."""

    name: str
    width: int
    height: int
    x_ticks: int
    y_ticks: int


WIDE, NARROW = Size("wide", 720, 300, 9, 6), Size("narrow", 344, 240, 5, 5)
SMALL = Size("small", 344, 168, 5, 4)
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 14, 42
"""Room around the axes for their labels, px."""

ROW_PX = 15.0
"""Height of a line of labels."""

LETTER_PX = 6.5
"""Approximate width of a letter of a label: 12 px sans-serif."""


@dataclass(frozen=True, slots=True)
class Tick:
    """`at` in px along its axis."""

    at: float
    label: str


@dataclass(frozen=True, slots=True)
class Path:
    """`d` of an SVG path, or `dots`, which are circles (x, y). `number` chooses the colour."""

    d: str
    shape: str
    number: int
    dots: tuple[Point, ...] = ()


@dataclass(frozen=True, slots=True)
class Area:
    """A rectangle over the whole height."""

    x: float
    width: float
    tone: str
    name: str


@dataclass(frozen=True, slots=True)
class Line:
    """At `at` px, with a label at `row_y` px that begins (or ends) at its side."""

    at: float
    name: str
    anchor: str
    row_y: float


@dataclass(frozen=True, slots=True)
class Drawing:
    """All coordinates of a chart at one size, px; `limits` are heights."""

    size: Size
    left: float
    right: float
    top: float
    bottom: float
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    grounds: tuple[Area, ...]
    bands: tuple[Path, ...]
    paths: tuple[Path, ...]
    marks: tuple[Line, ...]
    limits: tuple[float, ...]


def legend(charts: Sequence[Chart]) -> list[tuple[str, str]]:
    """(class, name) of everything that a legend of some plots must name, each once: series where a plot has several,
    limits, grounds."""
    named: dict[tuple[str, str], None] = {}
    for chart in charts:
        if len(chart.series) > 1:
            named |= {(f"s{number} {each.shape}", each.name): None for number, each in enumerate(chart.series)}
        named |= {("limit", each.name): None for each in chart.limits}
        named |= {(f"ground {each.tone}", each.name): None for each in chart.grounds}
    return list(named)


def layout(chart: Chart, size: Size) -> Drawing:
    """The chart at a size."""
    xs = [x for each in chart.series for x, y in each.points if isfinite(x) and isfinite(y)]
    xs += [x for each in chart.grounds for x in (each.begin, each.end)]
    ys = [y for each in chart.series for _, y in each.points if _shown(y, chart)]
    ys += [y for each in chart.series for _, low, high in each.band for y in (low, high) if _shown(y, chart)]
    ys += [each.at for each in chart.limits if _shown(each.at, chart)]
    x_low, x_high = _ends(xs, chart.log_x, 0.0, False)
    y_low, y_high = _ends(ys, chart.log_y, 0.06, chart.from_zero)
    left, right, bottom = float(LEFT), float(size.width - RIGHT), float(size.height - BOTTOM)

    def x_of(x: float) -> float:
        return left + (right - left) * _share(x, x_low, x_high, chart.log_x)

    marks = _marks([(x_of(each.at), each.name) for each in chart.marks if x_low <= each.at <= x_high], right)
    top = max((line.row_y + ROW_PX / 2 for line in marks if line.name), default=float(TOP))

    def y_of(y: float) -> float:
        return bottom - (bottom - top) * _share(y, y_low, y_high, chart.log_y)

    tick_values = chart.x_ticks or tuple((x, tick_label(x)) for x in _round(x_low, x_high, chart.log_x, size.x_ticks))
    bands = (
        Path(_band([(x_of(x), y_of(low), y_of(high)) for x, low, high in each.band]), "band", number)
        for number, each in enumerate(chart.series)
        if each.band
    )
    paths = []
    for number, each in enumerate(chart.series):
        at = [(x_of(x), y_of(y)) if _shown(y, chart) else None for x, y in each.points]
        dots = tuple((round(p[0], 1), round(p[1], 1)) for p in at if p is not None) if each.shape == "points" else ()
        paths.append(Path("" if dots else _joined(at, each.shape == "steps"), each.shape, number, dots))
    grounds = tuple(
        Area(round(x_of(each.begin), 1), round(max(x_of(each.end) - x_of(each.begin), 1.0), 1), each.tone, each.name)
        for each in chart.grounds
    )
    y_marks = _round(y_low, y_high, chart.log_y, size.y_ticks)
    return Drawing(
        size=size, left=left, right=right, top=top, bottom=bottom,
        x_ticks=_without_overlap([Tick(round(x_of(x), 1), text) for x, text in tick_values]),
        y_ticks=tuple(Tick(round(y_of(y), 1), tick_label(y)) for y in y_marks),
        grounds=grounds, bands=tuple(bands), paths=tuple(paths),
        marks=marks, limits=tuple(round(y_of(each.at), 1) for each in chart.limits if _shown(each.at, chart)),
    )  # fmt: skip


def _shown(y: float, chart: Chart) -> bool:
    return isfinite(y) and (y > 0 or not chart.log_y)


def _ends(values: list[float], log: bool, margin: float, from_zero: bool) -> tuple[float, float]:
    """Ends of an axis, with a share of its length as margin. Even with one value, or none, an axis has a length."""
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    if log:
        low, high = (low, high) if values and low > 0 else (0.1, 1.0)
        low, high = (low / 2, high * 2) if high <= low else (low, high)
        spread = (high / low) ** margin
        return low / spread, high * spread
    low = min(low, 0.0) if from_zero else low
    if high <= low:
        reach = abs(low) / 2 or 1.0
        low, high = (low, high + reach) if from_zero else (low - reach, high + reach)
    reach = margin * (high - low)
    return (low if from_zero and low == 0.0 else low - reach), high + reach


def _share(value: float, low: float, high: float, log: bool) -> float:
    if log:
        value, low, high = log10(max(value, low / 10)), log10(low), log10(high)
    return (value - low) / (high - low)


def _round(low: float, high: float, log: bool, most: int) -> list[float]:
    return logarithmic_ticks(low, high) if log else linear_ticks(low, high, most)


def _without_overlap(every: list[Tick]) -> tuple[Tick, ...]:
    """The ticks whose labels do not run into each other."""
    spaced: list[Tick] = []
    for tick in every:
        room = LETTER_PX * (len(tick.label) + len(spaced[-1].label)) / 2 + 6 if spaced else 0.0
        if not spaced or tick.at - spaced[-1].at >= room:
            spaced.append(tick)
    return tuple(spaced)


def _marks(every: Sequence[tuple[float, str]], right: float) -> tuple[Line, ...]:
    """Marks (x, name) with their names above the plot, in as many rows as names need not to run into each other."""
    ends: list[float] = []
    lines = []
    for at, name in sorted(every):
        length = LETTER_PX * len(name) + 8
        begin, anchor = (at, "start") if at + length <= right else (at - length, "end")
        row = next((number for number, end in enumerate(ends) if begin >= end), len(ends))
        ends[row : row + 1] = [begin + length]
        lines.append(Line(round(at, 1), name, anchor, TOP + ROW_PX * row))
    return tuple(lines)


def _joined(points: Sequence[Point | None], steps: bool) -> str:
    """The line through the points, broken where a point is None."""
    parts: list[str] = []
    before: Point | None = None
    for point in points:
        if point is not None:
            x, y = point
            if before is None:
                parts.append(f"M{x:.1f} {y:.1f}")
            else:
                parts.append(f"H{x:.1f}V{y:.1f}" if steps else f"L{x:.1f} {y:.1f}")
        before = point
    return "".join(parts)


def _band(edges: Sequence[tuple[float, float, float]]) -> str:
    around = [(x, low) for x, low, _ in edges] + [(x, high) for x, _, high in reversed(edges)]
    return _joined(around, steps=False) + "Z"


DISC_SIDE_PX = 344
"""Width and height of a drawing, px: a phone shows it without shrinking it."""

DISC_RADIUS_PX = 132.0
"""Radius of the disc, px; labels stand around it."""


@dataclass(frozen=True, slots=True)
class DotKind:
    """What a dot stands for.

    Attributes:
        tone: its colour, as in `page.Tone`.
        shape: its shape, which tells kinds apart without colour.
        full: whether it is filled or hollow.
    """

    name: str
    tone: str
    shape: Literal["circle", "cross"]
    full: bool


@dataclass(frozen=True, slots=True)
class Dot:
    """A dot right of and above the centre, as shares of the radius; `description` is shown when a reader points at
    it."""

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
        description: what the plot shows, in a sentence, for readers who cannot see it.
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
