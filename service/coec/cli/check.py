"""`coec check`: the content of a recording, what it lacks, and whether a calibration is possible."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from coec.calibration_options import SolverOptions, configuration_of
from coec.cli.options import Depth, Fix, Json, Source, show_correction
from coec.errors import CalibrationError, SourceError
from coec.reports import console
from coec.reports.console import StageTimes
from coec.reports.formatting import count

if TYPE_CHECKING:
    from coec.calibration.types import Estimate, Mistake
    from coec.io.recordings.layouts import RecordingSource
    from coec.reports.recording_fitness import Cadence, Fitness, Notice

PAIRS = 12
"""Most pairs of the trial, evenly chosen: half as many as a calibration takes."""

REFUSES, MAY_REFUSE = "calibrate will refuse this, because ", "calibrate may refuse this, because "

TOO_FEW = "too_few_frames"
"""Code of the remark that a trial of the same few frames outweighs if it is accepted."""

NOT_IN_VIEW = "little_in_view"
"""Code of the remark whose cause the trial may find: a mistake in the inputs."""

LEVEL_STYLES = {"fail": "bold red", "warn": "bold yellow", "ok": ""}


def check(
    source: Source,
    depth: Depth = None,
    as_json: Json = False,
    fix: Fix = False,
) -> int:
    """Show the content of a recording and predict the verdict: exit 1 if a calibration is impossible or refused."""
    from coec.calibration.monitor.check_verdict import MIN_PAIRS
    from coec.io.recordings.layouts import open_source
    from coec.io.recordings.manifest import manifest_of
    from coec.reports.recording_fitness import Notice, find_damaged, fitness_of

    manifest = manifest_of(source) if fix else None
    try:
        recording = open_source(source)
    except SourceError:
        if not as_json:
            _show_topics(source)
        raise
    with console.progress() as bars:
        times = StageTimes(bars)
        find_damaged(recording, lambda done, total: times.step("read", done, total))
        seen = fitness_of(recording)
        times.step("examine", 1, 1)
        # A wrong pose may leave nothing in view. Which mistake it is, the trial finds.
        failed = any(note.level == "fail" and note.code not in (TOO_FEW, NOT_IN_VIEW) for note in seen.remarks)
        trial, mistake = (None, None) if failed else _trial(recording, depth, times)
    if _is_accepted(trial):
        enough = f"{count(seen.camera.frames, 'camera frame')} suffice here; a check by the service needs {MIN_PAIRS}."
        remarks = (replace(n, level="warn", text=enough) if n.code == TOO_FEW else n for n in seen.remarks)
        seen = replace(seen, remarks=tuple(remarks))
    of_mistake = () if mistake is None else (Notice("fail", mistake.code, mistake.text),)
    others = (note for note in seen.remarks if mistake is None or note.code != mistake.code)
    every = (*of_mistake, *others, *_of_trial(trial, seen, mistake))
    notes = tuple(sorted(every, key=lambda note: list(LEVEL_STYLES).index(note.level)))  # the most important first
    console.report(
        _document(source, replace(seen, remarks=notes), trial, mistake),
        lambda: _show(recording.name, replace(seen, remarks=notes), trial),
        as_json=as_json,
    )
    if manifest is not None and mistake is not None:
        show_correction(manifest, mistake, recording.rig)
    return int(any(note.level == "fail" for note in notes))


def _trial(
    recording: RecordingSource, depth: str | None, times: StageTimes
) -> tuple[Estimate | CalibrationError, Mistake | None]:
    """A calibration of a few pairs near the recording's own extrinsic: shows how well this scene fixes the pose; if it
    is refused, with the probable mistake in the inputs."""
    from coec.config import LimitsConfig
    from coec.io.depth.depth_maps import open_depth
    from coec.io.images import GreyImages
    from coec.io.recordings import window_cutting
    from coec.recording import MistakenInputError, calibrated, mistake_of_recording

    loaded = window_cutting.window_of_recording(recording, PAIRS, lambda done, total: times.step("load", done, total))
    window = loaded.window
    configuration = configuration_of(SolverOptions(depth=depth), loaded.configuration)
    limits = LimitsConfig()
    try:
        trial, mistake = calibrated(
            window, open_depth(configuration.depth, limits), GreyImages(limits), configuration, times
        )
        return trial, mistake if _is_accepted(trial) else mistake_of_recording(loaded, mistake)
    except MistakenInputError as error:
        return error, error.mistake
    except CalibrationError as error:
        return error, None


def _of_trial(trial: Estimate | CalibrationError | None, seen: Fitness, mistake: Mistake | None) -> tuple[Notice, ...]:
    """What the trial says of a calibration: for what it will be refused, and what a longer window may remedy. Clocks
    that are apart look like a camera that moves."""
    from coec.calibration.search.mistakes import CLOCK_OFFSET
    from coec.calibration.types import MOVED
    from coec.reports.recording_fitness import Notice, pairs_of_calibration, reasons_that_stay

    if isinstance(trial, CalibrationError):
        return (Notice("fail", "no_calibration", f"{REFUSES}{trial}"),)
    if trial is None:
        return ()
    explained = (MOVED,) if mistake is not None and mistake.code == CLOCK_OFFSET else ()
    staying = tuple(one for one in reasons_that_stay(trial, pairs_of_calibration(seen)) if one.code not in explained)
    others = (one for one in trial.verdict.reasons if one not in staying and one.code not in explained)
    return (
        *(
            Notice("fail", reason.code, f"{'and because ' if rank else REFUSES}{reason.text}")
            for rank, reason in enumerate(staying)
        ),
        *(Notice("warn", reason.code, f"{MAY_REFUSE}{reason.text}") for reason in others),
    )


def _prediction(seen: Fitness, trial: Estimate | CalibrationError | None) -> str:
    """`refused`, `accepted`, or `unclear`: the verdict of a calibration, as far as the trial tells."""
    if any(note.level == "fail" for note in seen.remarks):
        return "refused"
    return "accepted" if _is_accepted(trial) else "unclear"


def _is_accepted(trial: Estimate | CalibrationError | None) -> bool:
    from coec.calibration.types import Decision, Estimate

    return isinstance(trial, Estimate) and trial.verdict.decision is Decision.ACCEPTED


def _document(
    source: str, seen: Fitness, trial: Estimate | CalibrationError | None, mistake: Mistake | None
) -> dict[str, Any]:
    from coec.calibration.types import Estimate
    from coec.io.serialise import degrees_or_null, mistake_of

    document = {
        "source": source,
        **asdict(seen),
        "prediction": _prediction(seen, trial),
        "trial": None,
        "mistake": None if mistake is None else mistake_of(mistake).model_dump(mode="json"),
    }
    if isinstance(trial, Estimate):
        document["trial"] = {
            "pairs": trial.pairs,
            "decision": trial.verdict.decision.value,
            "correction": degrees_or_null(trial.correction),
            "sigma": degrees_or_null(trial.sigma),
        }
    return document


def _show(name: str, seen: Fitness, trial: Estimate | CalibrationError | None) -> None:
    from coec.calibration.types import Estimate

    console.show(f"{name}: {seen.seconds:.1f} s")
    streams = console.table("stream", "frames", "Hz", "longest gap", "what", right=(1, 2, 3))
    camera = f"{seen.width} x {seen.height} px"
    rings = f", {seen.rings} rings" if seen.rings > 1 else ""
    near, far = seen.range_m
    lidar = f"{seen.points} points{rings}, {near:.1f} to {far:.0f} m, {'with' if seen.point_time else 'without'} time"
    _add(streams, "camera", seen.camera, camera)
    _add(streams, "LiDAR", seen.lidar, lidar)
    _add(streams, "motion", seen.motion, _motion_text(seen))
    console.out.print(streams)
    if seen.timed_by:
        console.show(f"point times are {seen.timed_by}")
    sync = (
        ""
        if seen.sync_ms is None
        else f", camera {seen.sync_ms[0]:+.1f} ms after the sweep ({seen.sync_ms[1]:.1f} at most)"
    )
    console.show(f"{seen.paired:.0%} of the camera frames have a sweep{sync}; {seen.in_view:.0%} of its points in view")
    if isinstance(trial, Estimate):
        _show_trial(trial)
    for note in seen.remarks:
        console.show(f"{note.level:4}  {note.text}", LEVEL_STYLES[note.level])
    if all(note.level == "ok" for note in seen.remarks):
        console.show("nothing is missing", "green")


def _show_trial(trial: Estimate) -> None:
    from coec.io.serialise import degrees_or_null

    axes = console.table("axis", "from the recording's own", "± σ", "unit", right=(1, 2))
    correction, sigma = degrees_or_null(trial.correction), degrees_or_null(trial.sigma)
    for axis, axis_name in enumerate(console.AXIS_NAMES):
        if sigma[axis] is not None:
            offset = console.figure(correction[axis], sign=True)
            axes.add_row(axis_name, offset, console.figure(sigma[axis]), console.UNITS[axis])
    console.show(f"{count(trial.pairs, 'pair')}, tried at the recording's own extrinsic:")
    console.out.print(axes)


def _show_topics(source: str) -> None:
    from coec.io.recordings.recording_source import is_bag, parse_spec

    spec = parse_spec(source)
    if not is_bag(spec):
        return
    from coec.io.recordings.bag import open_topics

    # A damaged file has been reported already.
    with suppress(SourceError):
        bag = open_topics(replace(spec, query={}))
        table = console.table("topic", "type", "messages", "Hz", right=(2, 3))
        for topic, info in bag.infos.items():
            # Names in a file are not trusted.
            name, kind = (text if text.isprintable() else ascii(text) for text in (topic, info.type_name))
            table.add_row(name, kind, str(info.count), f"{info.rate_hz:.2f}")
        console.out.print(table)


def _add(table: Any, name: str, cadence: Cadence | None, what: str) -> None:
    if cadence is None:
        table.add_row(name, "none", "", "", what)
    else:
        table.add_row(name, str(cadence.frames), f"{cadence.rate_hz:.2f}", f"{cadence.longest_gap_s:.2f} s", what)


def _motion_text(seen: Fitness) -> str:
    if seen.turn_degps is None:
        return ""
    turn = f"{seen.turn_degps[0]:.1f} deg/s ({seen.turn_degps[1]:.1f})"
    if seen.speed_mps is None:
        return f"rotation only, {turn}"
    return f"{seen.speed_mps[0]:.1f} m/s ({seen.speed_mps[1]:.1f} at most), {turn}"
