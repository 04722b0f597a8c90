"""The log of decisions on a drive: what is in it, how two of them differ, and both for people to read.

A log is made of the records of a pair: every check, every window's estimate, every extrinsic that was served, every
state of health. It has one JSON object a line. States that the steady clock alone brings about, such as a check that is
overdue, have no sensor time and depend on the machine; a log leaves them out, and the return from them.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from coec.calibration.types import NS_PER_S
from coec.errors import SourceError, UsageError
from coec.reports.formatting import count
from coec.reports.page import Facts, Page, Section, Table, Text, write
from coec.service.records.history import CheckLog, PairHistory
from coec.service.records.pair_store import PairRecords

KINDS = ("check", "estimate", "extrinsic", "state")
"""Of decisions, in the order in which those of one stamp are listed."""

MOST_ENTRIES, MOST_CHECKS = 10_000, 100_000
"""Entries of the history, and checks, of a log: as many as a service can keep."""

MOST_BYTES = 2**28
"""Largest log that is read."""


@dataclass(frozen=True, slots=True)
class Decision:
    """One decision.

    Attributes:
        kind: one of `KINDS`.
        stamp_ns: sensor time of the data behind it.
        name: what it is about: id of the window, outcome of the checks, provenance of the extrinsic, state.
        values: everything that is compared.
    """

    kind: str
    stamp_ns: int
    name: str
    values: dict[str, Any]

    def line(self, pair: str) -> str:
        """As a line of a log."""
        return json.dumps({"pair": pair, **asdict(self)}, sort_keys=True, separators=(",", ":"))


def decisions_of(records: PairRecords) -> tuple[Decision, ...]:
    """The decisions in the records of a pair."""
    return tuple(sorted(_decisions(records), key=lambda one: (one.stamp_ns, KINDS.index(one.kind))))


def _decisions(records: PairRecords) -> Iterator[Decision]:
    for check in records.checks:
        values = check.model_dump(mode="json", exclude={"state"})
        yield Decision("check", check.stamp_ns, check.outcome, values)
    state = ""
    for record in records.entries:
        entry = record.entry
        if entry.stamp_ns is None or (entry.kind == "state" and entry.code == state):
            continue
        state = entry.code if entry.kind == "state" else state
        if record.result is not None:
            yield Decision("estimate", entry.stamp_ns, entry.code, record.result.model_dump(mode="json"))
        elif entry.kind in ("extrinsic", "state"):
            pose = None if entry.camera_from_lidar is None else entry.camera_from_lidar.model_dump(mode="json")
            values = {"code": entry.code, "window_id": entry.window_id, "camera_from_lidar": pose}
            yield Decision(entry.kind, entry.stamp_ns, entry.code, values)


def read_log(path: Path, pair: str) -> tuple[Decision, ...]:
    """The decisions about a pair in a log, or in the state directory of a service.

    Raises:
        SourceError: there is no such file, or it is neither.
    """
    if path.is_dir():
        return _of_state_directory(path, pair)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise SourceError(f"{path} is larger than {MOST_BYTES / 1e6:.0f} MB: it is no log of decisions")
        documents = [dict(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
        return tuple(
            Decision(str(one["kind"]), int(one["stamp_ns"]), str(one["name"]), dict(one["values"]))
            for one in documents
            if one.get("pair", pair) == pair  # logs of older versions are of one pair
        )
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise SourceError(f"{path} is no log of decisions: write one with `coec replay DRIVE --log FILE`") from error


def _of_state_directory(folder: Path, pair: str) -> tuple[Decision, ...]:
    """Reads copies of the files, because damaged ones are set aside when they are opened."""
    with TemporaryDirectory() as copies:
        try:
            for file in folder.glob(f"*-{pair}.jsonl"):
                if file.stat().st_size > MOST_BYTES:
                    raise SourceError(f"{file} is larger than {MOST_BYTES / 1e6:.0f} MB")
                shutil.copyfile(file, Path(copies) / file.name)
        except OSError as error:
            raise SourceError(f"{folder} cannot be read: {error.strerror}") from error
        history = PairHistory(Path(copies), pair, MOST_ENTRIES, {})
        checks = CheckLog(Path(copies) / f"checks-{pair}.jsonl", MOST_CHECKS)
        decisions = decisions_of(PairRecords(history.entries(), checks.checks(), ()))
    if not decisions:
        others = sorted(file.stem.removeprefix("checks-") for file in folder.glob("checks-*.jsonl"))
        hint = f"; it has those of {', '.join(others)}: give the service's --config" if others else ""
        raise SourceError(f"{folder} holds no records of a pair {pair}{hint}")
    return decisions


def write_log(path: Path, decisions: Mapping[str, Iterable[Decision]]) -> None:
    """Writes a log of the decisions about each pair.

    Raises:
        UsageError: the file cannot be written.
    """
    try:
        lines = [f"{one.line(pair)}\n" for pair, of_pair in decisions.items() for one in of_pair]
        path.write_text("".join(lines), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}") from error


@dataclass(frozen=True, slots=True)
class Difference:
    """A decision that differs. `before`, `after`: None if there is none of this kind at this sensor time. `fields`:
    places of the values that differ."""

    before: Decision | None
    after: Decision | None
    fields: tuple[str, ...] = ()

    @property
    def either(self) -> Decision:
        """The decision, of whichever log has it."""
        decision = self.after or self.before
        assert decision is not None
        return decision


def differences(before: Sequence[Decision], after: Sequence[Decision]) -> tuple[Difference, ...]:
    """What differs between two logs, in the order of sensor time. Decisions of one kind and stamp belong together."""
    keyed_before, keyed_after = _keyed(before), _keyed(after)
    result = []
    for key in sorted(keyed_before.keys() | keyed_after.keys()):
        one, other = keyed_before.get(key), keyed_after.get(key)
        if one is None or other is None:
            result.append(Difference(one, other))
        elif one.values != other.values:
            places = (place.partition("[")[0] for place, _, _ in value_differences(one.values, other.values))
            result.append(Difference(one, other, tuple(dict.fromkeys(places))))
    return tuple(result)


def _keyed(decisions: Sequence[Decision]) -> dict[tuple[int, int, int], Decision]:
    """By stamp, kind, and number among those of one stamp and kind."""
    keyed: dict[tuple[int, int, int], Decision] = {}
    for decision in decisions:
        kind = KINDS.index(decision.kind) if decision.kind in KINDS else len(KINDS)
        number = 0
        while (decision.stamp_ns, kind, number) in keyed:
            number += 1
        keyed[decision.stamp_ns, kind, number] = decision
    return keyed


def value_differences(before: Any, after: Any, at: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(place, before, after) of every value that differs between two documents."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            yield from value_differences(before.get(key), after.get(key), f"{at}.{key}" if at else str(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from value_differences(one, other, f"{at}[{index}]")
    elif before != after:
        yield at, before, after


# --- a replay, and what people read -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transition:
    """A step of the engine that did something. It is text, because the frames of its event must not stay in memory.

    Attributes:
        stamp_ns: sensor time of the drive.
        event, actions: what came, and what it led to.
        health: states of health before and after it.
    """

    stamp_ns: int
    event: str
    actions: tuple[str, ...]
    health: tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedDrive:
    """What the engine made of a drive.

    Attributes:
        decisions: in the order of sensor time.
        transitions: steps of the engine, in their order.
        losses: by place and cause.
        health: state of health at the end of the drive.
        begin_ns, end_ns: stamps of the first and the last frame.
        elapsed_s: time of the replay without the start of the workers, s.
    """

    decisions: tuple[Decision, ...]
    transitions: tuple[Transition, ...]
    losses: dict[tuple[str, str], int]
    health: str
    begin_ns: int
    end_ns: int
    elapsed_s: float

    @property
    def driven_s(self) -> float:
        """Length of the drive, s."""
        return (self.end_ns - self.begin_ns) / NS_PER_S


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
    path: Path,
    name: str,
    replayed: Mapping[str, ReplayedDrive],
    first_ns: int,
    differing: Mapping[str, Sequence[Difference]] | None,
) -> None:
    """Writes a page with the decisions of a drive about each pair and, if they were compared, what differs.

    Raises:
        RecordingError: the file cannot be written.
    """
    sections: list[Section] = []
    facts: list[tuple[str, str]] = []
    for pair, drive in replayed.items():
        of_pair = "" if len(replayed) == 1 else f"{pair}: "
        if differing is not None:
            sections.append(Section(f"{of_pair}Differences", (_differences(differing[pair], first_ns),)))
        rows = [(line.time, line.kind, line.name, line.text) for line in outline(drive.decisions, first_ns)]
        decisions = Table("In the order of sensor time.", HEADS, rows, frozenset({0}), frozenset({3}))
        sections.append(Section(f"{of_pair}Decisions", (decisions,)))
        losses = tuple((f"{place}, {cause}", str(number)) for (place, cause), number in sorted(drive.losses.items()))
        if losses:
            sections.append(Section(f"{of_pair}Losses", (Facts(losses),)))
        facts += [
            (f"{of_pair}Length of the drive", f"{drive.driven_s:.0f} s"),
            (f"{of_pair}Health at the end", drive.health),
            (f"{of_pair}Checks", str(sum(one.kind == "check" for one in drive.decisions))),
            (f"{of_pair}Windows", str(sum(one.kind == "estimate" for one in drive.decisions))),
        ]
    write(path, Page("Replay of a drive", name, (Facts(tuple(facts)),), tuple(sections)))


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
