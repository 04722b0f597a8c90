"""The board of `coec watch`: the fleet in a line, a row per pair, and a picture in half blocks."""

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from coec.config import LimitsConfig
from coec.reports import console
from coec.reports.formatting import count
from coec.schemas.documents import FleetNow, PairNow

KEYS = "↑↓ choose   r reasons   h history   o overlay   f filter   q quit"
"""The keys that can be pressed."""


def board(fleet: FleetNow, selected: int, first: int, rows: int, filtered: str) -> RenderableType:
    """The head, and `rows` of the pairs from `first` on; the one at `selected` is marked (-1: none)."""
    shown = fleet.pairs[first : first + rows]
    table = console.table(
        "", "vehicle", "pair", "state", "said", "checked", "drift", "± σ", "why", "event", right=(4, 5, 6, 7)
    )
    for index, pair in enumerate(shown, first):
        table.add_row(*_row(pair, marked=index == selected), style="reverse" if index == selected else "")
    below = fleet.matching - first - len(shown)
    foot = [Text(f"… and {below} more", "dim")] if below > 0 else []
    return Group(head(fleet, filtered), table, *foot)


def head(fleet: FleetNow, filtered: str) -> Text:
    """The fleet in a line."""
    line = Text(f"{count(fleet.vehicles, 'vehicle')}, {count(fleet.known, 'pair')}: ")
    for index, (state, pairs) in enumerate(fleet.states.items()):
        line.append(", " if index else "")
        line.append(f"{pairs} {state}", console.STATE_STYLES.get(state, "bold"))
    if filtered:
        line.append(f"   showing {fleet.matching}: {filtered}", "cyan")
    if fleet.refused:
        refused = ", ".join(f"{heartbeats} {cause}" for cause, heartbeats in sorted(fleet.refused.items()))
        line.append(f"   not taken: {refused}", "yellow")
    return line


def detail(pair: PairNow) -> RenderableType:
    """Everything that the last word of a pair holds."""
    word = pair.word
    lines: list[RenderableType] = [
        Text.assemble(
            f"{word.vehicle}/{word.pair}  ",
            state_text(pair),
            f" since {duration(max(word.said_ns - word.since_ns, 0) * 1e-9 + pair.said_s)}",
            f", said {duration(pair.said_s)} ago, by coec {console.plain(word.version)}, "
            f"configuration {console.plain(word.config_hash)}, {count(word.windows, 'window')}",
            ", held" if word.held else "",
        )
    ]
    lines += [
        Text(f"  {console.plain(reason.code)}: {console.plain(reason.text)}", "yellow") for reason in word.reasons
    ]
    if not word.reasons:
        lines.append(Text("  no reasons", "dim"))
    figures = Table(box=None, pad_edge=False, header_style="bold")
    figures.add_column("axis")
    for name in ("drift", "± σ", "correction", "± σ"):
        figures.add_column(name, justify="right")
    for axis, title in enumerate(console.AXIS_NAMES):
        columns: tuple[Sequence[float | None] | None, ...] = (
            word.drift,
            word.drift_sigma,
            word.correction,
            word.sigma,
        )
        values = [None if column is None else column[axis] for column in columns]
        signed = (True, False, True, False)
        cells = [console.figure(value, sign=sign) for value, sign in zip(values, signed, strict=True)]
        figures.add_row(f"{title} [{console.UNITS[axis]}]", *cells)
    served = f"served: {word.provenance or 'nothing yet'}, {console.attempt(word.status)}"
    event = f", newest incident {console.plain(word.event)}" if word.event else ""
    return Group(*lines, Text(served + event), figures)


def state_text(pair: PairNow) -> Text:
    """The state of a pair; for one that is silent now, its last state in brackets."""
    if pair.standing == "live":
        return console.styled(pair.word.state)
    style = console.STATE_STYLES["miscalibrated"] if pair.word.state == "miscalibrated" else "bold dim"
    return Text(f"{pair.standing} ({pair.word.state})", style)


def duration(seconds: float) -> str:
    """A duration in the unit that people would use."""
    for least, divisor, unit in ((172_800.0, 86_400.0, "d"), (7200.0, 3600.0, "h"), (120.0, 60.0, "min")):
        if seconds >= least:
            return f"{seconds / divisor:.0f} {unit}"
    return f"{seconds:.0f} s"


def _row(pair: PairNow, *, marked: bool) -> tuple[RenderableType, ...]:
    word = pair.word
    drift = sigma = "-"
    if pair.worst is not None and word.drift is not None:
        axis = console.AXES.index(pair.worst)
        unit = "°" if console.UNITS[axis] == "deg" else " m"
        drift = f"{pair.worst} {console.figure(word.drift[axis], 2, sign=True)}{unit}"
        deviation = None if word.drift_sigma is None else word.drift_sigma[axis]
        sigma = "-" if deviation is None else f"{console.figure(deviation, 2)}{unit}"
    return (
        Text("▶" if marked else " "),
        Text(word.vehicle),
        Text(word.pair),
        state_text(pair),
        Text(duration(pair.said_s)),
        Text("never" if pair.looked_s is None else duration(pair.looked_s)),
        Text(drift, "bold red" if pair.urgency >= 1.0 else ""),
        Text(sigma),
        Text(", ".join(console.plain(reason.code) for reason in word.reasons), overflow="ellipsis", no_wrap=True),
        Text(console.plain(word.event or "")),
    )


LIMITS = LimitsConfig(max_message_bytes=16 * 2**20, max_image_pixels=33_000_000)
"""Limits of a picture that came over a network."""


def half_block_text(jpeg: bytes, columns: int, rows: int) -> Text:
    """The picture in at most so many characters, with its proportions kept.

    Raises:
        DecodeError: it cannot be decoded, or is larger than a picture may be.
    """
    import cv2  # a board without a picture does without

    from coec.io.images import decode_bgr, probe

    pixels = decode_bgr(probe(jpeg, LIMITS), LIMITS)
    height, width = pixels.shape[:2]
    scale = min(columns / width, 2 * rows / height)
    size = (max(round(width * scale), 1), max(round(height * scale / 2), 1) * 2)
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    text = Text(no_wrap=True)
    for upper, lower in zip(small[::2], small[1::2], strict=True):
        for above, below in zip(upper, lower, strict=True):
            text.append("▀", f"{_colour(above)} on {_colour(below)}")
        text.append("\n")
    return text


def _colour(bgr: object) -> str:
    blue, green, red = (int(value) for value in bgr)  # type: ignore[attr-defined]
    return f"#{red:02x}{green:02x}{blue:02x}"
