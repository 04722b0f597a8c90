"""`coec replay`: a recorded decision again, from the file of its window alone; or a whole drive through the engine."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coec.cli.options import Json, Source
from coec.errors import SourceError, UsageError, WindowError
from coec.reports import console
from coec.reports.console import StageTimes
from coec.reports.formatting import count

if TYPE_CHECKING:
    from coec.calibration.types import Frame
    from coec.config import Config, PairConfig
    from coec.io.recordings.recording_source import RecordingSource
    from coec.schemas.rig_state import RigReply
    from coec.service.decision_log import Decision, Difference, ReplayedDrive

NS_PER_S = 1_000_000_000

AROUND_S = 1.0
"""Sensor time before and after the moment that is explained."""


Depth = Annotated[
    str | None,
    typer.Option(
        help="Depth network: of a window, if it has moved since; of a drive, in place of the configured one.",
        metavar="MODEL",
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option(help="Configuration of the service whose drive it is; else defaults.", metavar="FILE")
]
Pair = Annotated[str | None, typer.Option(help="Only this pair of the configuration; else all of them, as one rig.")]
Log = Annotated[Path | None, typer.Option(help="Write the decisions of the drive here (JSON lines).")]
Against = Annotated[
    Path | None,
    typer.Option(
        help="Compare the decisions with this log, or the state directory of a service; exit 1 if they differ.",
        metavar="LOG|DIR",
    ),
]
Begin = Annotated[float, typer.Option("--from", help="Begin so many seconds into the drive.", min=0.0)]
Until = Annotated[float | None, typer.Option("--until", help="End so many seconds into the drive.", min=0.0)]
Explain = Annotated[
    float | None,
    typer.Option("--explain", help="Show which events led to which actions so many seconds into the drive.", min=0.0),
]
Report = Annotated[Path | None, typer.Option(help="Write a page with the decisions and differences here.")]


def replay(
    source: Source,
    depth: Depth = None,
    config: ConfigFile = None,
    pair: Pair = None,
    log: Log = None,
    against: Against = None,
    begin_s: Begin = 0.0,
    until_s: Until = None,
    explain_s: Explain = None,
    report: Report = None,
    as_json: Json = False,
) -> int:
    """Reproduce the recorded decision of a window, or replay a whole drive through the engine of the service.

    A window with its result (.mcap) is solved again from the file alone: exit 1 if a byte of the result differs. Any
    other recording goes through the engine of the service, faster than real time and without losing a frame; its
    decisions are listed, and compared with those of another version or of a vehicle.
    """
    from coec.service.decision_log import read_log, write_log, write_replay_page

    window = Path(source)
    options = {
        "--config": config,
        "--pair": pair,
        "--log": log,
        "--against": against,
        "--from": begin_s or None,
        "--until": until_s,
        "--explain": explain_s,
        "--report": report,
    }
    given = [name for name, value in options.items() if value is not None]
    if _is_window(window, alone=not given):
        if given:
            raise UsageError(f"{window} is a window; {', '.join(given)} applies to the replay of a drive")
        return _replay_window(window, depth, as_json=as_json)
    if until_s is not None and until_s <= begin_s:
        raise UsageError(
            f"--until {until_s:g} is not later than --from {begin_s:g}: both count from the begin of the drive"
        )
    recordings, configuration = _opened(source, config, pair, depth)
    expected = {} if against is None else {name: read_log(against, name) for name in recordings}
    drives, rig = _replay_drive(recordings, configuration, begin_s, until_s)
    first_ns = min(recording.camera_stamps_ns[0] for recording in recordings.values())
    differing = {name: _compared(expected[name], drives[name]) for name in expected}
    if log is not None:
        write_log(log, {name: drive.decisions for name, drive in drives.items()})
    if report is not None:
        write_replay_page(report, source, drives, first_ns, differing or None)
    if as_json:
        documents = {name: _document(drive, differing.get(name)) for name, drive in drives.items()}
        whole = {"pairs": documents, "rig": rig.model_dump(mode="json")}
        console.print_json(whole if len(documents) > 1 else documents[next(iter(documents))])
    elif explain_s is not None:
        _explain(drives, first_ns, explain_s)
    else:
        _table(drives, first_ns)
        if len(drives) > 1:
            _show_rig(rig)
    if against is not None and not as_json:
        _show_differences(differing, against, first_ns)
    return 1 if any(differing.values()) else 0


# --- a window -------------------------------------------------------------------------------------------------------


def _is_window(path: Path, *, alone: bool) -> bool:
    """Whether this is the file of a window, with or without a result. A damaged file counts as one if it is given
    `alone`, without an option that applies to drives."""
    from coec.io.mcap.windows import is_window

    if path.suffix != ".mcap" or not path.is_file():
        return False
    try:
        return is_window(path)
    except SourceError:
        return alone


def _replay_window(window: Path, depth: str | None, *, as_json: bool) -> int:
    from coec.calibration.pipeline import calibrate
    from coec.config import LimitsConfig
    from coec.io.depth.depth_maps import open_depth
    from coec.io.images import GreyImages
    from coec.io.mcap.windows import read_result, read_window
    from coec.io.serialise import comparable, result_of
    from coec.schemas.message import to_json
    from coec.service.decision_log import value_differences

    recorded = read_result(window)
    if recorded is None:
        raise WindowError(f"{window} holds no result to compare with: `coec calibrate {window}` makes one")
    recorded_window, configuration = read_window(window)
    network = configuration.depth if depth is None else configuration.depth.model_copy(update={"model": depth})
    limits = LimitsConfig()
    with console.progress() as bars:
        estimate = calibrate(
            recorded_window, open_depth(network, limits), GreyImages(limits), configuration, StageTimes(bars)
        )
    reached = comparable(result_of(estimate, recorded_window.rig, recorded.vehicle), recorded)
    identical = to_json(reached) == to_json(recorded)
    differences = list(value_differences(recorded.model_dump(mode="json"), reached.model_dump(mode="json")))
    if as_json:
        console.print_json(
            {
                "window_id": recorded_window.window_id,
                "identical": identical,
                "differences": [{"field": f, "recorded": a, "reached": b} for f, a, b in differences],
                "result": reached.model_dump(mode="json"),
            }
        )
    elif identical:
        console.out.print(f"{recorded_window.window_id}: identical, ", console.styled(reached.verdict.decision), sep="")
    else:
        console.show(f"{recorded_window.window_id}: differs", "bold red")
        table = console.table("field", "recorded", "reached")
        for field, before, after in differences:
            table.add_row(field, str(before), str(after))
        console.out.print(table)
    return 0 if identical else 1


# --- a drive --------------------------------------------------------------------------------------------------------


def _opened(
    source: str, file: Path | None, name: str | None, depth: str | None
) -> tuple[dict[str, RecordingSource], Config]:
    """A recording for each pair, by its name, and the configuration of these pairs."""
    from coec.cli.convert import configuration_for
    from coec.config import Config, load_config
    from coec.io.recordings.layouts import open_source

    if file is None:
        recording = open_source(source)
        pair = configuration_for(recording, recording.T_camera_lidar_start, None)
        recordings, config = {pair.name: recording}, Config(pairs=(pair,))
    else:
        config = load_config(file)
        pairs = [pair for pair in config.pairs if name in (None, pair.name)]
        if not pairs:
            known = ", ".join(pair.name for pair in config.pairs)
            raise UsageError(f"{file} has no such pair: --pair is one of {known}")
        config = config.model_copy(update={"pairs": tuple(pairs)})
        recordings = {pair.name: _recording_of(source, pair, alone=len(pairs) == 1) for pair in pairs}
    if depth is not None:
        network = {"model": depth}
        pairs = [
            pair.model_copy(update={"calibration": pair.calibration.model_copy(update={"depth": of_pair})})
            for pair in config.pairs
            for of_pair in (pair.calibration.depth.model_copy(update=network),)
        ]
        config = config.model_copy(update={"pairs": tuple(pairs)})
    return recordings, config


def _recording_of(source: str, pair: PairConfig, *, alone: bool) -> RecordingSource:
    """The recording of a pair: a source of one camera and one LiDAR if it is `alone`; else the topics of a bag.

    Raises:
        UsageError: several pairs, and no bag or no topics.
        SourceError: the source cannot be opened.
    """
    from coec.io.recordings.layouts import open_source

    with TemporaryDirectory() as folder:
        of_pair = _with_topics(source, pair, Path(folder))
        if not alone:
            if of_pair is None:
                raise UsageError(
                    f"a rig is replayed from a bag and topics (`camera.topic`, `lidar.topic`): {source} is no bag, or "
                    f"pair {pair.name} has none; name one pair with --pair"
                )
            return open_source(of_pair)
        try:
            return open_source(source)
        except SourceError:
            if of_pair is None:
                raise
            return open_source(of_pair)


def _with_topics(source: str, pair: PairConfig, folder: Path) -> str | None:
    """A bag of several cameras or LiDARs, with the topics of a pair and its nominal calibration, which is written into
    `folder`, where the query names none; None for every other source, and for a pair without topics."""
    import json
    from urllib.parse import urlencode

    from coec.io.recordings.recording_source import is_bag, parse_spec

    spec = parse_spec(source)
    streams = {"camera": pair.camera, "points": pair.lidar, **({"odometry": pair.ego} if pair.ego else {})}
    topics = {key: stream.topic for key, stream in streams.items() if stream.topic and key not in spec.query}
    if not is_bag(spec) or not topics:
        return None
    if "intrinsics" not in spec.query:
        nominal = {"camera": pair.camera.intrinsics.model_dump(mode="json"), "T_camera_lidar": pair.T_camera_lidar}
        topics["intrinsics"] = str(folder / "nominal.yaml")
        Path(topics["intrinsics"]).write_text(json.dumps(nominal), encoding="utf-8")
    return f"{source}{'&' if spec.query else '?'}{urlencode(topics, safe='/')}"


def _replay_drive(
    recordings: Mapping[str, RecordingSource], config: Config, begin_s: float, until_s: float | None
) -> tuple[dict[str, ReplayedDrive], RigReply]:
    from coec.service.api.rig_answers import reply_of
    from coec.service.drive_replay import DriveReplay

    for recording in recordings.values():
        if not recording.camera_stamps_ns:
            raise SourceError(f"{recording.name} holds no camera frame")
    first_ns = min(recording.camera_stamps_ns[0] for recording in recordings.values())
    last_ns = max(recording.camera_stamps_ns[-1] for recording in recordings.values())
    begin_ns = first_ns + round(begin_s * NS_PER_S)
    end_ns = last_ns if until_s is None else first_ns + round(until_s * NS_PER_S)
    name = next(iter(recordings.values())).name
    if begin_ns > min(end_ns, last_ns):
        raise UsageError(f"no camera frame lies between --from and --until: {name} is shorter")

    def frames(recording: RecordingSource, kinds: tuple[str, ...]) -> Iterator[Frame]:
        # Motion before the first image and after the last one belongs to them.
        for frame in recording.messages(kinds=kinds):
            if until_s is not None and frame.stamp_ns > end_ns:
                return
            if begin_s == 0.0 or frame.stamp_ns >= begin_ns:
                yield frame

    with TemporaryDirectory() as folder, console.progress() as bars:
        task = bars.add_task(name, total=max((end_ns - begin_ns) / NS_PER_S, 1e-3))
        # A second worker only helps if reading and the engine leave it a core.
        workers = 2 if len(os.sched_getaffinity(0)) > 2 else 1
        drive = DriveReplay(config, Path(folder), begin_ns, workers)
        streams = {name: frames(recording, drive.kinds[name]) for name, recording in recordings.items()}
        drives = drive.run(streams, lambda stamp_ns: bars.update(task, completed=(stamp_ns - begin_ns) / NS_PER_S))
        return drives, reply_of(config.vehicle, drive.rig)


def _compared(expected: Sequence[Decision], drive: ReplayedDrive) -> tuple[Difference, ...]:
    from coec.service.decision_log import differences

    there = [one for one in expected if drive.begin_ns <= one.stamp_ns <= drive.end_ns]
    return differences(there, drive.decisions)


def _document(replayed: ReplayedDrive, differing: tuple[Difference, ...] | None) -> dict[str, Any]:
    return {
        "driven_s": replayed.driven_s,
        "elapsed_s": replayed.elapsed_s,
        "health": replayed.health,
        "decisions": [asdict(one) for one in replayed.decisions],
        "losses": [
            {"place": place, "cause": cause, "count": number}
            for (place, cause), number in sorted(replayed.losses.items())
        ],
        "differences": None
        if differing is None
        else [
            {
                "kind": one.either.kind,
                "stamp_ns": one.either.stamp_ns,
                "before": None if one.before is None else one.before.name,
                "after": None if one.after is None else one.after.name,
                "fields": one.fields,
            }
            for one in differing
        ],
    }


def _table(drives: Mapping[str, ReplayedDrive], first_ns: int) -> None:
    """Prints what was decided, without the checks that changed nothing."""
    from coec.service.decision_log import outline

    for name, drive in drives.items():
        if len(drives) > 1:
            console.show(name, "bold")
        checks = [one for one in drive.decisions if one.kind == "check"]
        windows = [one for one in drive.decisions if one.kind == "estimate"]
        table = console.table("s", "decision", "", "")
        for line in outline(drive.decisions, first_ns):
            table.add_row(line.time, line.kind, line.name, line.text)
        console.out.print(table)
        lost = sum(drive.losses.values())
        console.show(
            f"{count(len(checks), 'check')}, {count(len(windows), 'window')}, {count(lost, 'loss', 'losses')}, "
            f"{drive.health} at the end"
        )
    pace = drive.driven_s / max(drive.elapsed_s, 1e-9)
    console.show(f"{drive.driven_s:.0f} s of driving in {drive.elapsed_s:.0f} s ({pace:.1f} times as fast)")


def _show_rig(rig: RigReply) -> None:
    """Prints the state of every sensor at the end of the drive."""
    table = console.table("sensor", "state", "")
    for sensor in rig.sensors:
        table.add_row(sensor.name, console.styled(sensor.state), " ".join(reason.text for reason in sensor.reasons))
    console.out.print(table)


def _show_differences(differing: Mapping[str, tuple[Difference, ...]], against: Path, first_ns: int) -> None:
    number = sum(len(of_pair) for of_pair in differing.values())
    if not number:
        console.show(f"equal to {against}", "bold green")
        return
    console.show(f"{count(number, 'difference')} from {against}", "bold red")
    table = console.table("pair", "s", "decision", "there", "here", "fields")
    for pair, one in ((pair, one) for pair, of_pair in differing.items() for one in of_pair):
        before, after = one.before, one.after
        table.add_row(
            pair,
            f"{(one.either.stamp_ns - first_ns) / NS_PER_S:.1f}",
            one.either.kind,
            "none" if before is None else before.name,
            "none" if after is None else after.name,
            ", ".join(one.fields[:4]) + (" ..." if len(one.fields) > 4 else ""),
        )
    console.out.print(table)


def _explain(drives: Mapping[str, ReplayedDrive], first_ns: int, moment_s: float) -> None:
    """Prints the steps of the engine around a moment of the drive."""
    table = console.table("pair", "s", "event", "actions", "health")
    steps = [(name, one) for name, drive in drives.items() for one in drive.transitions]
    for name, one in sorted(steps, key=lambda step: step[1].stamp_ns):
        at_s = (one.stamp_ns - first_ns) / NS_PER_S
        if abs(at_s - moment_s) <= AROUND_S:
            before, after = one.health
            health = after if before == after else f"{before} to {after}"
            table.add_row(name, f"{at_s:.1f}", one.event, ", ".join(one.actions) or "none", health)
    if not table.row_count:
        raise UsageError(f"the engine did nothing within {AROUND_S:g} s of {moment_s:g} s")
    console.out.print(table)
