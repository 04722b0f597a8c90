"""What a replay of a drive decided, for people to read: lines of a table, and a page."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from coec.reports.formatting import count
from coec.reports.page import Facts, Page, Section, Table, Text, write
from coec.service.decision_log import Decision, Difference
from coec.service.drive_replay import ReplayedDrive
from coec.service.timing import NS_PER_S


@dataclass(frozen=True, slots=True)
class OutlineLine:
    """A decision as a line; `time` is in seconds of the drive."""

    time: str
    kind: str
    name: str
    text: str


def outline(decisions: Sequence[Decision], first_ns: int) -> Iterator[OutlineLine]:
    """The decisions of a drive that begins at `first_ns`; checks that say what the one before them said are counted."""
    before, repeated = "", 0
    for decision in decisions:
        if decision.kind == "check" and decision.name == before:
            repeated += 1
            continue
        if repeated:
            yield OutlineLine("", "check", before, f"{count(repeated, 'more check')}")
            repeated = 0
        before = decision.name if decision.kind == "check" else before
        seconds = f"{(decision.stamp_ns - first_ns) / NS_PER_S:.1f}"
        yield OutlineLine(seconds, decision.kind, decision.name, _text(decision))
    if repeated:
        yield OutlineLine("", "check", before, f"{count(repeated, 'more check')}")


def _text(decision: Decision) -> str:
    values = decision.values
    match decision.kind:
        case "check":
            return f"evidence {values['evidence']:.1f}, {'flagged' if values['flagged'] else 'not flagged'}"
        case "estimate":
            sigma = [value for value in values["sigma"][:3] if value is not None]
            reasons = " ".join(reason["text"] for reason in values["verdict"]["reasons"])
            text = f"{values['window_id']}, {values['pairs']} pairs"
            return f"{text}, σ {max(sigma):.2f}°. {reasons}" if sigma else f"{text}. {reasons}"
        case "extrinsic":
            return "" if values["window_id"] is None else f"by {values['window_id']}"
        case _:
            return ""


def write_replay_page(
    path: Path, name: str, replayed: ReplayedDrive, first_ns: int, differing: Sequence[Difference] | None
) -> None:
    """Writes a page with the decisions of a drive and, if they were compared, what differs.

    Raises:
        RecordingError: the file cannot be written.
    """
    rows = [(line.time, line.kind, line.name, line.text) for line in outline(replayed.decisions, first_ns)]
    sections = [
        Section("Decisions", (Table("In the order of sensor time.", HEADS, rows, frozenset({0}), frozenset({3})),))
    ]
    if differing is not None:
        sections.insert(0, Section("Differences", (_differences(differing, first_ns),)))
    losses = tuple((f"{place}, {cause}", str(number)) for (place, cause), number in sorted(replayed.losses.items()))
    if losses:
        sections.append(Section("Losses", (Facts(losses),)))
    facts = Facts(
        (
            ("Length of the drive", f"{replayed.driven_s:.0f} s"),
            ("Health at the end", replayed.health),
            ("Checks", str(sum(one.kind == "check" for one in replayed.decisions))),
            ("Windows", str(sum(one.kind == "estimate" for one in replayed.decisions))),
        )
    )
    write(path, Page("Replay of a drive", name, (facts,), tuple(sections)))


HEADS = ("Time, s", "Decision", "Outcome", "Details")


def _differences(differing: Sequence[Difference], first_ns: int) -> Table | Text:
    if not differing:
        return Text(("The decisions are equal.",))
    rows = [
        (
            f"{(one.either.stamp_ns - first_ns) / NS_PER_S:.1f}",
            one.either.kind,
            "none" if one.before is None else one.before.name,
            "none" if one.after is None else one.after.name,
            ", ".join(one.fields),
        )
        for one in differing
    ]
    heads = ("Time, s", "Decision", "There", "Here", "Values that differ")
    return Table("Decisions that differ.", heads, rows, frozenset({0}), frozenset({4}))
