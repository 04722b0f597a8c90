"""The pictures of `coec evaluate --output DIR`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path

from coec.calibration.solver import prepare_window_data
from coec.calibration.types import Silence
from coec.io import user_files
from coec.io.recordings import window_cutting
from coec.reports import pictures
from coec.reports.close_ups import Caption
from coec.reports.page import Block, Text
from coec_lab.experiments import evaluation_charts, objective_scans, plots, solve_experiments, solve_statistics
from coec_lab.experiments.evaluation_charts import bullseye
from coec_lab.experiments.evaluation_schema import FramesPoint, SlicePoint
from coec_lab.experiments.evaluation_tables import setting, verdict
from coec_lab.experiments.solve_statistics import NormalisedErrors, SolveOutcome

LANDSCAPE = (
    "The objective and its cues along each axis about the reference, from their lowest to their highest value: a "
    "good one has one peak, at zero."
)


@dataclass(frozen=True, slots=True)
class Starts:
    """Radii and number of the starts: degrees, metres."""

    rotation_deg: float
    translation_m: float
    directions: int

    def __str__(self) -> str:
        return setting(self.rotation_deg, self.translation_m)


@dataclass(frozen=True, slots=True)
class EvaluationBlocks:
    """Blocks of an evaluation's page: where searches ended, and the start that ended farthest from the reference."""

    ends: tuple[Block, ...]
    worst: tuple[Block, ...]


def write(
    folder: Path,
    bench: solve_experiments.Bench,
    of_starts: Starts,
    outcomes: Sequence[SolveOutcome],
    frames: Sequence[FramesPoint],
    slices: Sequence[SlicePoint],
    on_progress: Callable[[int, str], None],
) -> EvaluationBlocks:
    """Writes the bullseye, landscapes, errors against the amount of data where they were asked for, and the worst start
    beside where it ended.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    dof = bench.configuration.search.dof
    title = (
        f"{bench.window.window_id}: {bench.configuration.objective.kind}, {dof} degrees of freedom, "
        f"{len(bench.window.pairs)} frames"
    )
    hits = sum(outcome.hit for outcome in outcomes)
    unit = solve_experiments.sphere_directions(of_starts.directions)
    spheres = {"Rotation vectors of the starts": unit}
    if of_starts.translation_m > 0:
        spheres["Translations of the starts"] = unit[solve_experiments.translation_partners(of_starts.directions)]
    rate = f"{hits} of {len(outcomes)} starts hit, from {of_starts}"
    user_files.write_output(folder / "bullseye.png", plots.bullseye(outcomes, spheres, f"{title}\n{rate}"))
    if frames:
        about = f"{title} and fewer\n{solve_experiments.SUBSETS} subsets of each size, from {of_starts}"
        user_files.write_output(folder / "frames.png", plots.error_against_frames(frames, dof == 6, about))
    if slices:
        about = f"{title} in all\n{solve_experiments.SUBSETS} solves of each length, from {of_starts}"
        user_files.write_output(folder / "slices.png", plots.error_against_slice(slices, dof == 6, about))
    seen = write_landscape(folder, bench, title, on_progress)
    ends = (bullseye({"": outcomes}, spheres), Text((LANDSCAPE,), quiet=True), evaluation_charts.landscape(seen))
    return EvaluationBlocks(ends, _write_worst(folder, bench, outcomes))


def write_comparison(
    folder: Path, window_id: str, of_starts: Starts, outcomes: Mapping[str, Sequence[SolveOutcome]]
) -> tuple[Block, ...]:
    """Writes the bullseyes of all methods side by side.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    title = f"{window_id}: {of_starts.directions} starts, {of_starts}"
    unit = solve_experiments.sphere_directions(of_starts.directions)
    user_files.write_output(folder / "bullseye.png", plots.compared(outcomes, unit, title))
    return (bullseye(outcomes, {"starts": unit}),)


def write_normalised(folder: Path, name: str, errors: Mapping[str, NormalisedErrors]) -> None:
    """Writes normalised.png: errors over what was claimed for them, by what they are measured against.

    Raises:
        OutputError: the folder or the file cannot be written.
    """
    user_files.write_output(folder / "normalised.png", plots.normalised(errors, name))


def write_landscape(
    folder: Path, bench: solve_experiments.Bench, title: str, on_progress: Callable[[int, str], None]
) -> Mapping[str, objective_scans.Views]:
    """Writes profiles.png, the fused objective and its cues about the reference, and returns what it shows."""
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    window_data = prepare_window_data(window, bench.depth, bench.images, bench.configuration, Silence())
    named = objective_scans.landscapes(window_data, bench.configuration)
    seen = objective_scans.views(named, bench.reference, bench.configuration.search.dof, on_progress)
    user_files.write_output(folder / "profiles.png", plots.landscape(seen, f"{title}\nabout the source's calibration"))
    return seen


def _write_worst(folder: Path, bench: solve_experiments.Bench, outcomes: Sequence[SolveOutcome]) -> tuple[Block, ...]:
    index = solve_statistics.worst(outcomes)
    outcome = outcomes[index]
    start_deg = window_cutting.rotation_error_deg(outcome.trial.start, bench.reference)
    end_deg = degrees(outcome.rotation_rad)
    caption = Caption(
        before=f"worst start (number {index}, {start_deg:.2f}° off)",
        after=f"its end ({verdict(outcome)}, {end_deg:.2f}° off)",
        network=pictures.network_text(bench.configuration.depth.model, bench.depth.identity),
    )
    estimate = outcome.trial.estimate
    comparison = pictures.write_comparison(
        folder,
        bench.window,
        outcome.trial.start,
        outcome.T_camera_lidar,
        caption,
        bench.configuration.motion_compensation,
        None if estimate is None else estimate.uncertainty.independent_samples,
    )
    return comparison.blocks
