"""`coec evaluate`: options and their combinations. `starts_experiment` and `experiments.closure` do the work."""

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from coec.calibration_options import SolverOptions
from coec.cli.options import SOURCE_HELP, DegreesOfFreedom, Json, with_calibration_options
from coec.errors import UsageError

ALL = "all"
"""Value of `--objective` for all objectives, one after the other."""

Radius = Annotated[
    float, typer.Option(help="Radius of the sphere of starts, degrees.", metavar="R", min=0, show_default=False)
]
OptionalSource = Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)]
TwoSources = Annotated[
    tuple[str, str] | None,
    typer.Option(
        help="Instead of SOURCE: two cameras (or LiDARs) of one vehicle, each calibrated by itself; reports the "
        "difference between their results and the pose between them.",
        metavar="A B",
    ),
]
Relative = Annotated[
    str | None,
    typer.Option(
        help="With --closure: pose of sensor A in the frame of B, degrees and metres. Default: from the "
        "calibrations of both recordings.",
        metavar="RX,...,TZ",
    ),
]
RadiusMetres = Annotated[float, typer.Option(help="Radius of the sphere of starts, metres.", metavar="T", min=0)]
Objective = Annotated[
    str | None,
    typer.Option(
        help="Objective to maximise: fused, mi, intensity as for calibrate, or all three side by side: all.",
        metavar="NAME",
    ),
]
Dof = Annotated[
    DegreesOfFreedom | None,
    typer.Option(help="Rotation only, or translation too; 6 if --translation-m is given.", show_default=False),
]
AgainstFrames = Annotated[
    bool, typer.Option("--against-frames", help="Also solve windows of 1, 2, 3, 5, ... frames: frames.png.")
]
AgainstSlice = Annotated[
    bool, typer.Option("--against-slice", help="Also solve slices of 1/16 to all of the recording: slices.png.")
]
Halves = Annotated[
    int,
    typer.Option(
        help="Also split the frames N times at random into disjoint halves and compare their results.",
        metavar="N",
        min=0,
    ),
]
Nees = Annotated[
    int,
    typer.Option(
        help="Also compare errors with claimed standard deviations: N consecutive windows against the truth (for a "
        "recording: its own calibration), and N splits into halves: normalised.png.",
        metavar="N",
        min=0,
    ),
]
Detection = Annotated[
    int,
    typer.Option(
        help="Also report how well moved extrinsics are detected, over N splits of the frames, as diagnose does.",
        metavar="N",
        min=0,
    ),
]
Steps = Annotated[
    int,
    typer.Option(
        help="Also simulate steps of several sizes in the recording, N of each at random times: is the window "
        "refused, and is the time right?",
        metavar="N",
        min=0,
    ),
]


@with_calibration_options(SolverOptions)
def evaluate(
    rotation_deg: Radius,
    source: OptionalSource = "",
    closure: TwoSources = None,
    relative: Relative = None,
    directions: Annotated[int, typer.Option(help="Number of starts.", metavar="N", min=1)] = 200,
    translation_m: RadiusMetres = 0.0,
    objective: Objective = None,
    dof: Dof = None,
    against_frames: AgainstFrames = False,
    against_slice: AgainstSlice = False,
    halves: Halves = 0,
    nees: Nees = 0,
    detection: Detection = 0,
    steps: Steps = 0,
    output: Annotated[
        Path | None, typer.Option(help="Write plots, overlays, starts.csv and report.json.", metavar="DIR")
    ] = None,
    as_json: Json = False,
    **options: Any,
) -> int:
    """Solve from starts all around the source's calibration: hit rate, bias, spread, and reliability of verdicts."""
    if bool(source) == (closure is not None):
        raise UsageError("coec evaluate: give a SOURCE, or --closure A B, and not both")
    if closure is None and relative is not None:
        raise UsageError("--relative is the pose between two sources: it needs --closure A B")
    others = (against_frames, against_slice, halves, nees, detection, steps, options.get("camera_model"))
    if closure is not None and (objective == ALL or any(others)):
        raise UsageError(
            "--closure is an experiment of its own: leave out --objective all, --against-frames, --against-slice, "
            "--halves, --nees, --detection, --steps and --camera-model"
        )
    from coec_lab.commands import starts_experiment
    from coec_lab.experiments import closure as closure_experiment
    from coec_lab.experiments.evaluation_run import Plan

    given = {**options, "objective": objective, "dof": None if dof is None else int(dof)}
    choices = cast("SolverOptions", given)
    frames, camera_model = options.get("frames"), options.get("camera_model")
    plan = Plan(
        rotation_deg=rotation_deg,
        translation_m=translation_m,
        directions=directions,
        against_frames=against_frames,
        against_slice=against_slice,
        halves=halves,
        nees=nees,
        detection=detection,
        steps=steps,
    )
    if closure is not None:
        both = closure_experiment.ClosureRequest(closure, relative, frames, plan, choices)
        return closure_experiment.run(both, output, as_json=as_json)
    request = starts_experiment.EvaluationRequest(source, frames, camera_model, plan, choices)
    return starts_experiment.run(request, output, as_json=as_json)
