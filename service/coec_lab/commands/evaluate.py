"""What `coec evaluate` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import SOURCE_HELP, CameraModel, DegreesOfFreedom, Depth, Frames, Json, NoMotionCompensation
from coec.errors import UsageError


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given. `halves` and `detection` are numbers of splits, `nees` is one of
    windows and of splits, `steps` one of knocks of each kind; 0 = none."""

    rotation_deg: Annotated[
        float, typer.Option(help="Radius of the sphere of starts, degrees.", metavar="R", min=0, show_default=False)
    ]
    source: Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)] = ""
    closure: Annotated[
        tuple[str, str] | None,
        typer.Option(
            help="Instead of SOURCE: two cameras (or LiDARs) of one vehicle, each calibrated by itself; reports how "
            "far their results miss the pose between them.",
            metavar="A B",
        ),
    ] = None
    relative: Annotated[
        str | None,
        typer.Option(
            help="With --closure: pose of sensor A in the frame of B, degrees and metres. Default: from the "
            "calibrations of both recordings.",
            metavar="RX,RY,RZ,TX,TY,TZ",
        ),
    ] = None
    directions: Annotated[int, typer.Option(help="Number of starts.", metavar="N", min=1)] = 200
    translation_m: Annotated[
        float, typer.Option(help="Radius of the sphere of starts, metres.", metavar="T", min=0)
    ] = 0.0
    depth: Depth = None
    objective: Annotated[
        str | None,
        typer.Option(
            help="Objective to maximise: fused, mi, intensity as for calibrate, or all three side by side: all.",
            metavar="NAME",
        ),
    ] = None
    dof: Annotated[
        DegreesOfFreedom | None,
        typer.Option(help="Rotation only, or translation too; 6 if --translation-m is given.", show_default=False),
    ] = None
    camera_model: CameraModel = None
    frames: Frames = None
    no_motion_compensation: NoMotionCompensation = False
    against_frames: Annotated[
        bool, typer.Option("--against-frames", help="Also solve windows of 1, 2, 3, 5, ... frames: frames.png.")
    ] = False
    against_slice: Annotated[
        bool, typer.Option("--against-slice", help="Also solve slices of 1/16 to all of the recording: slices.png.")
    ] = False
    halves: Annotated[
        int,
        typer.Option(
            help="Also split the frames N times at random into disjoint halves and compare their results.",
            metavar="N",
            min=0,
        ),
    ] = 0
    nees: Annotated[
        int,
        typer.Option(
            help="Also compare errors with claimed standard deviations: N consecutive windows against the truth (for a "
            "recording: its own calibration), and N splits into halves: normalised.png.",
            metavar="N",
            min=0,
        ),
    ] = 0
    detection: Annotated[
        int,
        typer.Option(
            help="Also report how well moved extrinsics are detected, over N splits of the frames, as diagnose does.",
            metavar="N",
            min=0,
        ),
    ] = 0
    steps: Annotated[
        int,
        typer.Option(
            help="Also simulate knocks of several sizes in the recording, N of each at random times: is the window "
            "refused, and is the time right?",
            metavar="N",
            min=0,
        ),
    ] = 0
    output: Annotated[
        Path | None, typer.Option(help="Write plots, overlays, starts.csv and report.json.", metavar="DIR")
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Solve from starts all around the source's calibration: hit rate, bias, spread, and how good the verdicts are."""
    from coec_lab.commands import closure as closure_work
    from coec_lab.commands import evaluate as work

    if bool(options.source) == (options.closure is not None):
        raise UsageError("coec evaluate: give a SOURCE, or --closure A B, and not both")
    if options.closure is None:
        if options.relative is not None:
            raise UsageError("--relative tells the pose between two sources: it needs --closure A B")
        return work.run(options)
    others = (options.against_frames, options.against_slice, options.halves, options.nees, options.detection)
    if options.objective == work.ALL or any((*others, options.steps, options.camera_model)):
        raise UsageError(
            "--closure is an experiment of its own: leave out --objective all, --against-frames, --against-slice, "
            "--halves, --nees, --detection, --steps and --camera-model"
        )
    return closure_work.run(options, *options.closure)
