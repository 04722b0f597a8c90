"""`coec paper`: options. `paper_experiments` does the work."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Depth, Frames, Json, Source


def paper(
    source: Source,
    output: Annotated[
        Path, typer.Option(help="Folder for report.html, report.json and the figures.", metavar="DIR")
    ] = Path("coec-paper"),
    depth: Depth = None,
    objective: Annotated[str, typer.Option(help="mi (the paper's) or fused.", metavar="NAME")] = "mi",
    runs: Annotated[int, typer.Option(help="Number of solves per experiment.", min=1)] = 100,
    samples: Annotated[int, typer.Option(help="Number of samples of pairs for the failure metrics.", min=3)] = 100,
    frames: Frames = None,
    slice_s: Annotated[
        float | None, typer.Option(help="Cut the drive into windows of 25 pairs, each over this many seconds.", min=1.0)
    ] = None,
    as_json: Json = False,
) -> int:
    """Repeat the published experiments on a recording: metrics.png, bullseye.png, drive.png."""
    from coec_lab.commands import paper_experiments

    request = paper_experiments.PaperRequest(source, depth, objective, runs, samples, frames, slice_s)
    return paper_experiments.run(request, output, as_json=as_json)
