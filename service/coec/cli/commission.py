"""`coec commission`: learns the baseline of a rig from good windows of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coec.adapters.depth.maps import CachedDepth, open_depth
from coec.adapters.files.baseline_file import baseline_hash, baseline_to_json, load_baselines, save_baseline
from coec.adapters.files.output import try_file
from coec.adapters.images.codec import CachedGreys, GreyImages
from coec.calibration.commissioning.baseline import Baseline
from coec.calibration.commissioning.learning import MAX_PAIRS, commission
from coec.calibration.ports import DepthModel, ImageReader
from coec.calibration.types import Window
from coec.cli.commands.commission import Options
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig
from coec.errors import UsageError
from coec.library.choices import Choices, configuration_of
from coec.reports import console, page, provenance
from coec.reports.baseline_page import baselines_page
from coec.reports.page.words import count
from coec.reports.stage_times import StageTimes
from coec.sources import windows


@dataclass(frozen=True, slots=True, eq=False)
class Rigged:
    """Windows of one rig, and what is needed to look at them."""

    windows: tuple[Window, ...]
    configuration: CalibrationConfig
    depth: DepthModel
    images: ImageReader


def run(options: Options) -> int:
    """Prints and writes the baseline.

    Raises:
        CoecError: no baseline can be learned.
    """
    sensors = sensors_of(options.sensors or ())
    try_file(options.output)
    with console.progress() as bars:
        times = StageTimes(bars)
        rigged = load(options.sources, options, times)
        baseline = commission(
            rigged.windows,
            rigged.depth,
            rigged.images,
            rigged.configuration,
            sensors=sensors,
            false_alarm_rate=options.false_alarm_rate,
            progress=times,
        )
    save_baseline(options.output, baseline)
    told = page.write(
        _page_beside(options.output),
        baselines_page(
            load_baselines(options.output), baseline.pair, options.sources, options.output.name, provenance.here()
        ),
    )
    if options.as_json:
        console.print_json(document_of(baseline))
    else:
        show(baseline)
        console.show(f"written to {options.output}, with a page of it, {told.name}, beside it")
    return 0


def _page_beside(path: Path) -> Path:
    """`rig.html` for `rig.json`; never the baseline itself."""
    return path.with_suffix(".page.html" if path.suffix == ".html" else ".html")


def load(sources: Sequence[str], options: Options, times: StageTimes) -> Rigged:
    """The windows of all sources, with the configuration of the first.

    Raises:
        UsageError: no source, or an unknown value.
    """
    if not sources:
        raise UsageError("name at least one recording of a rig whose calibration is right")
    loaded = [
        windows.load(source, options.frames, WindowConfig().pairs, lambda done, total: times.step("load", done, total))
        for source in sources
    ]
    dof = None if options.dof is None else int(options.dof)
    choices = Choices(depth=options.depth, objective=options.objective, dof=dof)
    configuration = configuration_of(choices, loaded[0].configuration)
    depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), MAX_PAIRS)
    images = CachedGreys(GreyImages(LimitsConfig()), MAX_PAIRS)
    found = tuple(replace(one.window, T_camera_lidar_start=one.window.rig.T_camera_lidar_nominal) for one in loaded)
    return Rigged(found, configuration, depth, images)


def sensors_of(named: Sequence[str]) -> dict[str, str]:
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
    sigma = baseline.accuracy.sigma(baseline.pairs)
    return {
        "baseline": baseline_to_json(baseline),
        "hash": baseline_hash(baseline),
        "bias": _in_degrees(baseline.bias),
        "bias_sigma": _in_degrees(np.nan_to_num(baseline.bias_sigma)),
        "sigma_of_a_window": _in_degrees(np.nan_to_num(sigma)),
    }


def show(baseline: Baseline) -> None:
    """Prints the baseline for people."""
    console.show(
        f"{baseline.pair}: commissioned from {count(baseline.pairs, 'pair')} of "
        f"{count(baseline.windows, 'window')}, hash {baseline_hash(baseline)}"
    )
    show_learned(baseline)


def show_learned(baseline: Baseline) -> None:
    """Prints bias, limits, and what the limits detect, as tables."""
    table = console.table("axis", "bias", "± σ", "σ of a check at 6 pairs", "unit", right=(1, 2, 3))
    bias, known = _in_degrees(baseline.pose.bias), _in_degrees(baseline.pose.bias_sigma)
    of_check = _in_degrees(baseline.pose.sigma(6))
    for axis, name in enumerate(console.AXIS_NAMES):
        table.add_row(
            name,
            console.figure(bias[axis], sign=True),
            console.figure(known[axis]),
            console.figure(of_check[axis]),
            console.UNITS[axis],
        )
    console.out.print(table)
    limits = console.table("limit of a check", "value", right=(1,))
    monitor = baseline.monitor
    for name, value in (
        ("mi, nats, at least", monitor.min_mi),
        ("f', nats per rad, at most", monitor.max_f1),
        ("f'', nats per rad², at least", monitor.min_f2),
        ("distance² over rotations, σ², at most", monitor.max_distance2_rotation),
        ("distance² of the farthest axis, σ², at most", monitor.max_farthest2_pose),
        ("edges per pair, at least", monitor.min_edges_per_pair),
        ("agreement of the witnesses, deg, at most", float(np.degrees(monitor.max_agreement_rad))),
        ("overlap, at least", monitor.min_overlap),
    ):
        limits.add_row(name, console.figure(value))
    console.out.print(limits)
    if baseline.limits:
        verdicts = console.table("limit of a calibration", "value", right=(1,))
        for name, value in sorted(baseline.limits.items()):
            verdicts.add_row(name, console.figure(value))
        console.out.print(verdicts)
    caught = ", ".join(f"{name} {100 * share:.0f} %" for name, share in baseline.detected.items())
    console.show(
        f"at {100 * baseline.false_alarm_rate:g} % false alarms, looks at the moved extrinsic flagged: {caught}"
    )


def _in_degrees(rad_m: Any) -> list[float]:
    values = np.array(rad_m, dtype=np.float64)
    values[:3] = np.degrees(values[:3])
    return [float(value) for value in values]
