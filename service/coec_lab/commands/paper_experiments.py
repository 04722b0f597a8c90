"""The experiments of `coec paper`: those of the paper, repeated on a recording, next to the published figures."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from math import degrees, radians
from pathlib import Path
from typing import Any

import numpy as np

from coec.calibration.solver import depth_features, prepare_window_data
from coec.calibration.types import Silence
from coec.calibration_options import SolverOptions, configuration_of
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig
from coec.errors import SourceError
from coec.io import user_files
from coec.io.depth.depth_maps import open_depth
from coec.io.recordings import window_cutting
from coec.io.recordings.layouts import open_source
from coec.reports import console, page
from coec.reports.page import Block
from coec.reports.page_parts import Provenance
from coec_lab.experiments import evaluation_charts, paper_figures, plots, solve_experiments, solve_statistics
from coec_lab.experiments.paper_figures import Plots, paper_page, run_times
from coec_lab.experiments.solve_experiments import Bench, Stages, greys_of, inferred
from coec_lab.experiments.solve_statistics import SolveOutcome

FAR_DEG, DRIVE_DEG = 25.0, (5.0, 10.0)
"""Radii of the starts in the published experiments."""

MARGIN_DEG = 5.0
"""How far the search reaches beyond its start."""

DRIVE_PAIRS = 5
"""Pairs of one slice of a short drive; the paper takes 25 of 11,518 frames, and so does `slice_s`."""


@dataclass(frozen=True, slots=True)
class PaperRequest:
    """What is repeated.

    Attributes:
        depth: network; None: the usual one.
        runs: solves of each experiment.
        samples: samples of pairs for the failure metrics.
        frames: most camera frames; None: the usual number.
        slice_s: length of the windows of the drive, s; None: slices of `DRIVE_PAIRS` pairs.
    """

    source: str
    depth: str | None
    objective: str
    runs: int
    samples: int
    frames: int | None
    slice_s: float | None


def run(request: PaperRequest, folder: Path, *, as_json: bool) -> int:
    """Writes metrics.png, bullseye.png, drive.png, report.json and report.html, and prints what is in them.

    Raises:
        CoecError: an experiment is not possible.
    """
    user_files.try_folder(folder)
    with console.progress() as bars:
        stages = Stages(bars)
        load = stages.begin("load", None)
        loaded = window_cutting.load_window(
            request.source, request.frames, WindowConfig().pairs, lambda done, _: load(done, "")
        )
        choices = SolverOptions(depth=request.depth, objective=request.objective)
        configuration = configuration_of(choices, loaded.configuration)
        window = loaded.window
        depth = inferred(
            window, open_depth(configuration.depth, LimitsConfig()), stages.begin("depth", len(window.pairs))
        )
        bench = Bench(window, depth, greys_of(window), configuration)
        failure, metrics = _failure_metrics(bench, request, folder, stages)
        far, ends = _bullseye(bench, request, folder, stages)
        along, drive = _drive(bench, request, folder, stages)
        document: dict[str, Any] = {
            "source": request.source,
            "objective": request.objective,
            "pairs": len(window.pairs),
            "failure_metrics": failure,
            "bullseye": far,
            "drive": along,
            "run_times": [asdict(row) for row in run_times(request.source, configuration, stages)],
            "published": paper_figures.document(),
        }
    written = user_files.write_output(folder / "report.json", json.dumps(document, sort_keys=True, indent=1).encode())
    page.write(folder / "report.html", paper_page(document, Plots(metrics, ends, drive), Provenance.here()))
    if as_json:
        console.print_json(document)
    else:
        console.show_block(paper_figures.moves_table(failure["moves"]))
        console.show_block(paper_figures.solves_table(document))
        console.show_block(paper_figures.times_table(document["run_times"]))
        console.show(f"written to {written.parent}")
    return 0


def _failure_metrics(bench: Bench, request: PaperRequest, folder: Path, stages: Stages) -> tuple[dict[str, Any], Block]:
    """Learns limits on every second pair and applies them to the others; returns the figures and a plot."""
    data = prepare_window_data(bench.window, bench.depth, bench.images, bench.configuration, Silence())
    frames = depth_features(data, bench.reference)
    on_done = stages.begin("metrics", 2 * request.samples)
    rig, right = bench.window.rig, bench.reference
    known = paper_figures.failure_figures(
        frames[::2], rig, right, bench.configuration, request.samples, lambda done, _: on_done(done, "")
    )
    limits = paper_figures.learned(known)
    tried = paper_figures.failure_figures(
        frames[1::2] or frames, rig, right, bench.configuration, request.samples,
        lambda done, _: on_done(request.samples + done, ""),
    )  # fmt: skip
    rows = [
        {
            "moved_deg": moved,
            "checks": request.samples,
            "flagged": float(np.mean([limits.flags(f) for f in tried if f.moved_deg == moved])),
        }
        for moved in paper_figures.MOVES_DEG
    ]
    shares = ", ".join(f"{row['moved_deg']:g}°: {100 * row['flagged']:.1f} %" for row in rows)
    title = (
        f"{bench.window.window_id}: equation (2), limits learned on the other half of the pairs; flagged at {shares}"
    )
    figures = evaluation_charts.failure_figures(tried, limits)
    user_files.write_output(folder / "metrics.png", plots.charts(figures, title, 3, (4.7, 4.6)))
    return {"limits": asdict(limits), "moves": rows}, figures


def _bullseye(bench: Bench, request: PaperRequest, folder: Path, stages: Stages) -> tuple[dict[str, Any], Block]:
    on_done = stages.begin(f"{FAR_DEG:g} deg", request.runs)
    far = Bench(bench.window, bench.depth, bench.images, _reaching(bench.configuration, FAR_DEG))
    outcomes = []
    for start in solve_experiments.start_poses(bench.reference, request.runs, radians(FAR_DEG), 0.0):
        outcomes.append(far.solve(start))
        on_done(len(outcomes), f"{sum(outcome.hit for outcome in outcomes)} hits")
    of = solve_statistics.summarise(outcomes)
    title = (
        f"{bench.window.window_id}: {request.objective}, {request.runs} runs from {FAR_DEG:g}°: {of.hits} hits, "
        f"{100 * of.classified_correctly:.0f} % classified correctly"
    )
    spheres = {"Rotation vectors of the starts": solve_experiments.sphere_directions(request.runs)}
    user_files.write_output(folder / "bullseye.png", plots.bullseye(outcomes, spheres, title))
    return {"start_deg": FAR_DEG, **_figures(outcomes)}, evaluation_charts.bullseye({"": outcomes}, spheres)


def _drive(bench: Bench, request: PaperRequest, folder: Path, stages: Stages) -> tuple[list[dict[str, Any]], Block]:
    """Solves every window of the drive from starts all around, in all about `runs` solves for each radius."""
    count = _window_count(bench, request)
    per_window = max(request.runs // count, 1)
    on_done = stages.begin("drive", len(DRIVE_DEG) * count * per_window)
    solved: dict[float, list[tuple[float, SolveOutcome]]] = {radius_deg: [] for radius_deg in DRIVE_DEG}
    done = 0
    for number, (middle_s, of_window, indices) in enumerate(_drive_windows(bench, request)):
        for radius_deg in DRIVE_DEG:
            near = replace(of_window, configuration=_reaching(bench.configuration, radius_deg))
            poses = solve_experiments.start_poses(bench.reference, per_window * count, radians(radius_deg), 0.0)
            # Every window gets starts from all over the sphere.
            for start in poses[number::count]:
                solved[radius_deg].append((middle_s, near.solve(start, indices)))
                done += 1
                on_done(done, "")
    if not done:
        raise SourceError(f"{request.source}: no window of {request.slice_s:g} s has a pair of picture and sweep")
    rows = [
        {
            "start_deg": radius_deg,
            **_figures([outcome for _, outcome in outcomes]),
            "windows": [
                {
                    "middle_s": middle_s,
                    "error_deg": np.degrees(outcome.error[:3]).tolist(),
                    "accepted": outcome.accepted,
                }
                for middle_s, outcome in outcomes
            ],
        }
        for radius_deg, outcomes in solved.items()
    ]
    windows = f"{count} window{'' if count == 1 else 's'}"
    title = f"{bench.window.window_id}: {request.objective}, {windows}"
    named = {f"from {radius_deg:g}°": outcomes for radius_deg, outcomes in solved.items()}
    errors = evaluation_charts.drive(named)
    user_files.write_output(folder / "drive.png", plots.charts(errors, title, 1, (11.0, 2.9)))
    return rows, errors


def _window_count(bench: Bench, request: PaperRequest) -> int:
    if request.slice_s is None:
        return len(paper_figures.slices(len(bench.window.pairs), DRIVE_PAIRS))
    return windows_of(open_source(request.source).camera_stamps_ns, request.slice_s)


def windows_of(stamps_ns: Sequence[int], slice_s: float) -> int:
    """How many windows of this length a recording with these frames has, at least one. Each frame stands for the time
    to the next: 1200 frames at 10 Hz are two minutes, although the last is taken 0.1 s before their end."""
    lasted_s = (stamps_ns[-1] - stamps_ns[0]) * 1e-9
    interval_s = lasted_s / max(len(stamps_ns) - 1, 1)
    # Half an interval of tolerance, because stamps jitter.
    return max(int((lasted_s + 1.5 * interval_s) // slice_s), 1)


def _drive_windows(bench: Bench, request: PaperRequest) -> Iterator[tuple[float, Bench, list[int]]]:
    """Middle (s after the first frame), bench and indices of the pairs of every window; one is loaded at a time."""
    pairs = bench.window.pairs
    if request.slice_s is None:
        for indices in paper_figures.slices(len(pairs), min(DRIVE_PAIRS, len(pairs))):
            middle = pairs[indices[len(indices) // 2]]
            yield (middle.stamp_ns - pairs[0].stamp_ns) * 1e-9, bench, indices
        return
    model = open_depth(bench.configuration.depth, LimitsConfig())
    for number in range(_window_count(bench, request)):
        begin_s, end_s = number * request.slice_s, (number + 1) * request.slice_s
        try:
            loaded = window_cutting.load_window(
                request.source, None, WindowConfig().pairs, lambda *_: None, (begin_s, end_s)
            )
        except SourceError:
            # A slice in which no camera frame has a sweep is no window.
            continue
        depth = inferred(loaded.window, model, lambda *_: None)
        of_slice = Bench(loaded.window, depth, greys_of(loaded.window), bench.configuration)
        yield 0.5 * (begin_s + end_s), of_slice, list(range(len(loaded.window.pairs)))


def _reaching(configuration: CalibrationConfig, radius_deg: float) -> CalibrationConfig:
    """The configuration with a search that reaches beyond starts at this radius."""
    reach = {"rotation_deg": radius_deg + MARGIN_DEG, "reach_deg": radius_deg + MARGIN_DEG}
    return configuration.model_copy(update={"search": configuration.search.model_copy(update=reach)})


def _figures(outcomes: Sequence[SolveOutcome]) -> dict[str, Any]:
    of = solve_statistics.summarise(outcomes)
    errors = np.degrees([outcome.error[:3] for outcome in outcomes])
    return {
        "runs": of.starts,
        "hits": of.hits,
        "classified_correctly": of.classified_correctly,
        "verdicts": of.verdicts.model_dump(),
        "rotation_deg": {
            "median": degrees(of.rotation_rad.median),
            "p95": degrees(of.rotation_rad.p95),
            "max": degrees(of.rotation_rad.max),
        },
        "mean_deg": errors.mean(axis=0).tolist(),
        "std_deg": errors.std(axis=0).tolist(),
    }
