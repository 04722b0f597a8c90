"""`coec models assess`: how good a depth network is for calibration, before it goes on a vehicle."""

from __future__ import annotations

import time
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from coec.cli.options import Frames, Json, Source

if TYPE_CHECKING:
    from coec.calibration.solver import WindowData
    from coec.calibration.types import DepthModel, Window
    from coec.schemas.replies import Vector3
    from coec_lab.experiments.depth_quality import DepthQuality
    from coec_lab.experiments.evaluation_schema import Maybe3, ModelAssessment
    from coec_lab.experiments.solve_experiments import Stages

STAGES = 3
"""Steps that an assessment reports."""

STYLES = {"good": "bold green", "usable_in_fused": "bold yellow", "do_not_use": "bold red"}


def assess(
    model: Annotated[
        str,
        typer.Argument(help="An ONNX file, a built-in name, or `stereo`.", metavar="MODEL", show_default=False),
    ],
    source: Source,
    frames: Frames = None,
    output: Annotated[
        Path | None, typer.Option(help="Write curves.png, joint.png, frame.png and report.json.", metavar="DIR")
    ] = None,
    as_json: Json = False,
) -> int:
    """Compare a depth network with the LiDAR of a calibrated recording: exit 1 if it is of no use there."""
    from coec.calibration.solver import prepare_window_data
    from coec.calibration.types import Silence
    from coec.calibration_options import SolverOptions, configuration_of
    from coec.config import LimitsConfig, WindowConfig
    from coec.io import user_files as files
    from coec.io.depth.depth_maps import STEREO, CachedDepth, open_depth
    from coec.io.images import GreyImages
    from coec.io.recordings import window_cutting
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.experiments import depth_quality
    from coec_lab.experiments.solve_experiments import Stages

    if output is not None:
        files.try_folder(output)
    with console.progress() as bars:
        stages = Stages(bars)
        load = stages.begin("load", None)
        loaded = window_cutting.load_window(source, frames, WindowConfig().pairs, lambda done, _: load(done, ""))
        window = loaded.window
        configuration = configuration_of(SolverOptions(depth=model, objective="mi", dof=3), loaded.configuration)
        depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), len(window.pairs))
        inference_ms = _infer(window, depth, stages)
        data = prepare_window_data(window, depth, GreyImages(LimitsConfig()), configuration, Silence())
        quality = depth_quality.assess(data, configuration, stages.begin("compare", STAGES))
        if output is not None:
            on_plotted = stages.begin("draw", None)
            _write_pictures(output, model, data, quality)
            on_plotted(1, "")
        elapsed_s = stages.elapsed_s()
    timed_ms: list[float | None] = inference_ms if model != STEREO else [None] * len(inference_ms)
    report = _report((model, source), window, depth.identity, quality, timed_ms, elapsed_s)
    if output is not None:
        files.write_output(output / "report.json", to_json(report))
    console.report(report, lambda: _show(report), as_json=as_json)
    return 1 if report.suitability == "do_not_use" else 0


def _infer(window: Window, depth: DepthModel, stages: Stages) -> list[float | None]:
    """Infers the depth of every frame; returns the milliseconds of each, decoding included.

    Raises:
        CalibrationError: a frame has no depth.
    """
    from coec.errors import CalibrationError, DecodeError

    on_done = stages.begin("depth", len(window.pairs))
    times_ms: list[float | None] = []
    for done, pair in enumerate(window.pairs, start=1):
        began_s = time.perf_counter()
        try:
            depth.infer(pair.camera)
        except DecodeError as error:
            raise CalibrationError(f"no depth for the camera frame at {pair.stamp_ns} ns: {error}") from error
        times_ms.append(1e3 * (time.perf_counter() - began_s))
        on_done(done, "")
    return times_ms


def _write_pictures(folder: Path, model: str, data: WindowData, quality: DepthQuality) -> None:
    from coec.config import LimitsConfig
    from coec.io import user_files as files
    from coec.io.images import decode_bgr
    from coec_lab.experiments import depth_quality, plots

    name = f"{Path(model).name} on {data.window.window_id}"
    _, sentence = depth_quality.suitability(quality)
    files.write_output(folder / "joint.png", plots.joint(quality.joint, f"{name}, {len(quality.pairings)} frames"))
    files.write_output(folder / "curves.png", plots.curves(quality, f"{name}\n{sentence}"))
    index = len(data.window.pairs) // 2
    frame, pairing = data.window.pairs[index].camera, quality.pairings[index]
    title = f"{name}, frame at {frame.stamp_ns} ns: rank correlation {pairing.rank_correlation:+.2f}"
    picture = plots.frame(decode_bgr(frame.image, LimitsConfig()), data.depth.infer(frame).values, pairing, title)
    files.write_output(folder / "frame.png", picture)


def _report(
    names: tuple[str, str],
    window: Window,
    identity: str,
    quality: DepthQuality,
    times_ms: list[float | None],
    elapsed_s: dict[str, float],
) -> ModelAssessment:
    """The report of a network and a source, by their `names`."""
    import numpy as np

    from coec.reports.page_parts import finite_or_none
    from coec_lab.experiments import depth_quality
    from coec_lab.experiments.evaluation_schema import DepthFrame, ModelAssessment

    suitability, sentence = depth_quality.suitability(quality)
    timed = [value for value in times_ms if value is not None]
    return ModelAssessment(
        model=names[0],
        source=names[1],
        window_id=window.window_id,
        pairs=len(window.pairs),
        depth_identity=identity,
        suitability=suitability.value,
        verdict=sentence,
        rank_correlation=finite_or_none(quality.rank_correlation),
        covered=quality.covered,
        inference_ms=float(np.median(timed)) if timed else None,
        mi=quality.mi,
        mi_of_unrelated=quality.mi_of_unrelated,
        mi_over_unrelated=quality.mi_over_unrelated,
        bias_deg=cast("Vector3", tuple(np.degrees(quality.bias).tolist())),
        half_width_deg=cast("Maybe3", tuple(finite_or_none(degrees(width)) for width in quality.half_width)),
        # Per square degree.
        peakedness_per_deg2=cast("Vector3", tuple((quality.peakedness / degrees(1.0) ** 2).tolist())),
        search_deg=depth_quality.SEARCH_DEG,
        frames=tuple(
            DepthFrame(
                stamp_ns=pair.stamp_ns,
                points=len(pairing.value),
                covered=pairing.covered,
                rank_correlation=finite_or_none(pairing.rank_correlation),
                inference_ms=elapsed_ms,
            )
            for pair, pairing, elapsed_ms in zip(window.pairs, quality.pairings, times_ms, strict=True)
        ),
        elapsed_s=elapsed_s,
    )


def _show(report: ModelAssessment) -> None:
    from coec.reports import console
    from coec.reports.formatting import count

    console.show(f"{Path(report.model).name} on {report.window_id}: {count(report.pairs, 'pair')}")
    console.show(report.verdict, STYLES[report.suitability])
    figures = console.table("figure", "value", "unit", right=(1,))
    figures.add_row("rank correlation with inverse range", console.figure(report.rank_correlation, 2, sign=True), "")
    figures.add_row("points in view with a value", console.figure(100 * report.covered, 1), "%")
    figures.add_row("MI at the calibration", console.figure(report.mi), "nats")
    figures.add_row("MI with other frames' maps", console.figure(report.mi_of_unrelated), "nats")
    figures.add_row("ratio of the two", console.figure(report.mi_over_unrelated, 2), "")
    figures.add_row("inference of one frame", console.figure(report.inference_ms, 1), "ms")
    console.out.print(figures)
    axes = console.table("MI about", "optimum", "half-width of the peak", "f''/f per deg²", "unit", right=(1, 2, 3))
    for axis in range(3):
        axes.add_row(
            console.AXIS_NAMES[axis],
            console.figure(report.bias_deg[axis], 2, sign=True),
            console.figure(report.half_width_deg[axis], 1),
            console.figure(report.peakedness_per_deg2[axis], 4),
            "deg",
        )
    console.out.print(axes)
    worst = min(report.frames, key=lambda frame: abs(frame.rank_correlation or 0.0))
    console.show(
        f"worst frame: {worst.stamp_ns} ns, rank correlation {console.figure(worst.rank_correlation, 2, sign=True)}"
    )
    console.show("  ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.elapsed_s.items()))
