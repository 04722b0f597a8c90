"""`coec commission`: learns the baseline of a rig from good windows of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coec.calibration_options import SolverOptions, configuration_of
from coec.cli.options import SOURCE_HELP, Depth, Dof, Frames, Json, Objective
from coec.errors import UsageError
from coec.reports import console
from coec.reports.console import StageTimes
from coec.reports.formatting import count

if TYPE_CHECKING:
    from coec.calibration.baseline import Baseline
    from coec.calibration.types import DepthModel, ImageReader, Window
    from coec.config import CalibrationConfig


@dataclass(frozen=True, slots=True, eq=False)
class RigWindows:
    """Windows of one rig, and what is needed to evaluate them."""

    windows: tuple[Window, ...]
    configuration: CalibrationConfig
    depth: DepthModel
    images: ImageReader


def commission(
    sources: Annotated[list[str], typer.Argument(metavar="SOURCE...", help=SOURCE_HELP, show_default=False)],
    output: Annotated[
        Path,
        typer.Option(
            help="Baseline to write, or to add the pair to; a report page is written beside it.", metavar="FILE"
        ),
    ] = Path("rig.json"),
    depth: Depth = None,
    objective: Objective = None,
    dof: Dof = None,
    frames: Frames = None,
    false_alarm_rate: Annotated[
        float, typer.Option(help="Fraction of checks at a right extrinsic that may be flagged.", min=1e-4, max=0.2)
    ] = 0.01,
    sensors: Annotated[
        list[str] | None,
        typer.Option(
            "--sensor",
            help="Serial number of a sensor: camera=SERIAL or lidar=SERIAL; repeatable.",
            metavar="STREAM=SERIAL",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Learn the baseline of a rig from windows in which its calibration is right: bias, spread, every limit."""
    from coec.calibration.commissioning import commission as learn
    from coec.io.rig_files import load_baselines, save_baseline
    from coec.io.user_files import try_file
    from coec.reports import page
    from coec.reports.diagnosis import baselines_page
    from coec.reports.page_parts import Provenance

    serials = _serials_of(sensors or ())
    try_file(output)
    given = SolverOptions(depth=depth, objective=objective, dof=None if dof is None else int(dof), frames=frames)
    with console.progress() as bars:
        times = StageTimes(bars)
        rig = load(sources, given, times)
        baseline = learn(
            rig.windows,
            rig.depth,
            rig.images,
            rig.configuration,
            sensors=serials,
            false_alarm_rate=false_alarm_rate,
            progress=times,
        )
    save_baseline(output, baseline)
    report = page.write(
        output.with_suffix(".page.html" if output.suffix == ".html" else ".html"),  # never the baseline itself
        baselines_page(load_baselines(output), baseline.pair, sources, output.name, Provenance.here()),
    )
    if as_json:
        console.print_json(document_of(baseline))
    else:
        show(baseline)
        console.show(f"written to {output}, with a page of it, {report.name}, beside it")
    return 0


def load(sources: Sequence[str], options: SolverOptions, times: StageTimes) -> RigWindows:
    """The windows of all sources, with the configuration of the first.

    Raises:
        UsageError: no source, or an unknown value.
    """
    from coec.calibration.commissioning import MAX_PAIRS
    from coec.config import LimitsConfig, WindowConfig
    from coec.io.depth.depth_maps import CachedDepth, open_depth
    from coec.io.images import CachedGreys, GreyImages
    from coec.io.recordings import window_cutting

    if not sources:
        raise UsageError("name at least one recording of a rig whose calibration is right")
    loaded = [
        window_cutting.load_window(
            source,
            options.get("frames"),
            WindowConfig().pairs,
            lambda done, total: times.step("load", done, total),
        )
        for source in sources
    ]
    configuration = configuration_of(options, loaded[0].configuration)
    depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), MAX_PAIRS)
    images = CachedGreys(GreyImages(LimitsConfig()), MAX_PAIRS)
    at_nominal = tuple(
        replace(one.window, T_camera_lidar_start=one.window.rig.T_camera_lidar_nominal) for one in loaded
    )
    return RigWindows(at_nominal, configuration, depth, images)


def _serials_of(named: Sequence[str]) -> dict[str, str]:
    """Serial numbers by stream, from `camera=SERIAL` and the like.

    Raises:
        UsageError: a text is not of this form.
    """
    sensors = {}
    for text in named:
        stream, _, serial = text.partition("=")
        if stream not in ("camera", "lidar") or not serial:
            raise UsageError(f"--sensor {text}: give camera=SERIAL or lidar=SERIAL")
        sensors[f"{stream}_serial"] = serial
    return sensors


def document_of(baseline: Baseline) -> dict[str, Any]:
    """What `--json` prints: the baseline as it is written, its hash, and bias and spread in degrees and metres."""
    import numpy as np

    from coec.io.rig_files import baseline_hash, baseline_to_json
    from coec.io.serialise import in_degrees

    sigma = baseline.accuracy.sigma(baseline.pairs)
    return {
        "baseline": baseline_to_json(baseline),
        "hash": baseline_hash(baseline),
        "bias": in_degrees(baseline.bias).tolist(),
        "bias_sigma": in_degrees(np.nan_to_num(baseline.bias_sigma)).tolist(),
        "sigma_of_a_window": in_degrees(np.nan_to_num(sigma)).tolist(),
    }


def show(baseline: Baseline) -> None:
    """Prints the baseline for people."""
    from coec.io.rig_files import baseline_hash

    console.show(
        f"{baseline.pair}: commissioned from {count(baseline.pairs, 'pair')} of "
        f"{count(baseline.windows, 'window')}, hash {baseline_hash(baseline)}"
    )
    show_learned(baseline)


def show_learned(baseline: Baseline) -> None:
    """Prints bias, limits, and what the limits detect, as tables."""
    from coec.io.serialise import in_degrees

    table = console.table("axis", "bias", "± σ", "σ of a check at 6 pairs", "unit", right=(1, 2, 3))
    bias, bias_sigma = in_degrees(baseline.pose.bias), in_degrees(baseline.pose.bias_sigma)
    of_check = in_degrees(baseline.pose.sigma(6))
    for axis, name in enumerate(console.AXIS_NAMES):
        table.add_row(
            name,
            console.figure(bias[axis], sign=True),
            console.figure(bias_sigma[axis]),
            console.figure(of_check[axis]),
            console.UNITS[axis],
        )
    console.out.print(table)
    _show_limits(baseline)
    detected = ", ".join(f"{name} {100 * share:.0f} %" for name, share in baseline.detected.items())
    console.show(
        f"at {100 * baseline.false_alarm_rate:g} % false alarms, checks of the moved extrinsic flagged: {detected}"
    )


def _show_limits(baseline: Baseline) -> None:
    import numpy as np

    limits = console.table("limit of a check", "value", right=(1,))
    monitor = baseline.monitor
    for name, value in (
        ("mi, nats, at least", monitor.min_mi),
        ("f', nats per rad, at most", monitor.max_f1),
        ("f'', nats per rad², at least", monitor.min_f2),
        ("distance² over rotations, σ², at most", monitor.max_distance2_rotation),
        ("distance² of the farthest axis, σ², at most", monitor.max_farthest2_pose),
        ("edges per pair, at least", monitor.min_edges_per_pair),
        ("agreement of the cues, deg, at most", float(np.degrees(monitor.max_agreement_rad))),
        ("overlap, at least", monitor.min_overlap),
    ):
        limits.add_row(name, console.figure(value))
    console.out.print(limits)
    if baseline.limits:
        verdicts = console.table("limit of a calibration", "value", right=(1,))
        for name, value in sorted(baseline.limits.items()):
            verdicts.add_row(name, console.figure(value))
        console.out.print(verdicts)
