"""`coec resample`: solves many real windows that are drawn from recordings with a known calibration."""

from __future__ import annotations

from typing import Annotated

import typer

from coec.cli.options import SOURCE_HELP, DegreesOfFreedom, Depth, Jobs, Json


def resample(
    recordings: Annotated[list[str], typer.Argument(metavar="SOURCE...", help=SOURCE_HELP, show_default=False)],
    windows: Annotated[int, typer.Option(help="Windows per recording.", min=1, max=100_000, metavar="N")] = 30,
    starts: Annotated[int, typer.Option(help="Starts per window.", min=1, metavar="K")] = 2,
    dof: Annotated[
        DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.", show_default="both")
    ] = None,
    rotation_deg: Annotated[
        float, typer.Option(help="Turn of the starts from the reference, degrees.", metavar="R", min=0)
    ] = 20.0,
    translation_m: Annotated[
        float, typer.Option(help="Shift of the starts, metres; with 3 dof there is none.", metavar="T", min=0)
    ] = 0.5,
    lens_errors: Annotated[
        bool,
        typer.Option(
            "--lens-errors",
            help="Give each window a wrong lens: cx or cy by 4 to 50 px, or the focal length by 2 to 45 %.",
        ),
    ] = False,
    depth: Depth = None,
    seed: Annotated[int, typer.Option(help="Seed of windows and starts.", min=0)] = 1,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Solve many real windows drawn from recordings: hits, verdicts, and whether σ is right.

    A window is a subset of the frames (three to all), often of a part of the image, of half its size, or with every
    second or fourth ring alone. Results are compared with the median accepted result of the whole recording, which is
    solved from starts next to its own calibration. A solve takes one to some seconds of a core.
    """
    from coec.reports import console
    from coec_lab.commands.drive_pool import finished
    from coec_lab.experiments import resampled_statistics as statistics
    from coec_lab.experiments.resampled_windows import Resampling, consensus, solve_resampled

    degrees_of_freedom = (3, 6) if dof is None else (int(dof),)
    planned = [
        Resampling(source, number, starts, rotation_deg, translation_m, lens_errors, seed, depth)
        for source in recordings
        for number in degrees_of_freedom
    ]
    rows, lenses = [], []
    with console.progress() as bars:
        task = bars.add_task("windows", total=len(planned) * windows, note="")
        for of in planned:
            bars.update(task, note=f"reference of {of.source}, {of.dof} dof")
            (reference,) = finished(consensus, [of], 1)
            solves = []
            for done in finished(solve_resampled, [(number, of, reference) for number in range(windows)], jobs):
                solves += done
                bars.update(task, advance=1, note=f"{sum(solve.hit for solve in solves)} of {len(solves)} hits")
            solves.sort(key=lambda solve: solve.number)
            rows.append(statistics.row_of(of, reference, solves))
            lenses += statistics.lens_rows(of, solves) if lens_errors else []
    report = statistics.ResampleReport(seed=seed, rows=tuple(rows), lenses=tuple(lenses))
    console.report(report, lambda: statistics.show(report), as_json=as_json)
    return 0
