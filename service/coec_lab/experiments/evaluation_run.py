"""One recording, one known pose, many starts around it: the flow of an evaluation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import degrees, radians
from typing import Any, Unpack, cast

from pydantic import ValidationError
from rich.progress import Progress as Bars

from coec import calibration_options
from coec.calibration.types import DepthModel, Matrix4, Window
from coec.calibration_options import Progress, SolverOptions, checked
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig, describe
from coec.errors import CalibrationError, UsageError
from coec.geometry.cameras import name_of
from coec.io.depth.depth_maps import open_depth
from coec.io.recordings import window_cutting
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import HasGroundTruth
from coec.recording import CallbackProgress, Recording, fit_camera
from coec.recording import Window as PublicWindow
from coec.reports.page_parts import finite_degrees
from coec.schemas.replies import Vector6
from coec_lab.experiments import evaluation_documents, mount_steps, solve_experiments, solve_statistics
from coec_lab.experiments.detection import require_enough
from coec_lab.experiments.evaluation_schema import DetectionReport, EvaluationReport, FramesPoint, SlicePoint, StepRow
from coec_lab.experiments.solve_experiments import Bench, Stages

MARGIN_DEG, MARGIN_M = 5.0, 0.2
REACH_MARGIN_DEG, REACH_MARGIN_M = 3.0, 0.15
"""How far the search box (`MARGIN_DEG`) and the reach of the global search (`REACH_MARGIN_DEG`) extend beyond the
starts at least, so that the reference never lies on a bound and a search may overshoot."""

SIMULATED_TRUTH, OWN_CALIBRATION = "the simulated truth", "the source's own calibration"
OTHER_HALF = "the other half of the frames"
"""The references from which normalised errors are counted."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Which experiments run. 0 and False leave one out.

    Attributes:
        rotation_deg, translation_m: radii of the spheres of starts.
        directions: number of starts.
        against_frames, against_slice: also solve windows of fewer frames, and slices of the recording.
        halves: number of random splits of the frames into disjoint halves.
        nees: number of consecutive windows whose errors are compared with the uncertainty that they claim.
        detection: number of splits over which it is measured how well moved extrinsics are detected.
        steps: number of knocks of each kind.
    """

    rotation_deg: float
    translation_m: float = 0.0
    directions: int = 200
    against_frames: bool = False
    against_slice: bool = False
    halves: int = 0
    nees: int = 0
    detection: int = 0
    steps: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """What is evaluated: a window of at most `frames` camera frames of a source (None: the usual number) and its depth.
    `depth` returns the maps that were inferred for the window; `model` infers those of other frames."""

    source: str
    frames: int | None

    window: Window
    model: DepthModel
    depth: DepthModel
    recorded: CalibrationConfig | None
    vehicle: str


@dataclass(slots=True, eq=False)
class Experiments:
    """Outcomes of the experiments that were asked for. `interrupted`: some are missing."""

    from_reference: solve_statistics.SolveOutcome
    outcomes: list[solve_statistics.SolveOutcome] = field(default_factory=list)
    frames: tuple[FramesPoint, ...] = ()
    slices: tuple[SlicePoint, ...] = ()
    halves: solve_statistics.Halves | None = None
    normalised: dict[str, solve_statistics.NormalisedErrors] = field(default_factory=dict)
    detection: DetectionReport | None = None
    steps: tuple[StepRow, ...] = ()
    interrupted: bool = False


def configuration_of(plan: Plan, options: SolverOptions, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """The configuration as for `coec calibrate`, with a search box that contains the starts. If the starts are moved in
    translation, six degrees of freedom are searched unless `options` say otherwise.

    Raises:
        UsageError: a value that does not exist, or starts farther away than any search box reaches.
    """
    if options.get("dof") is None and plan.translation_m > 0:
        options = {**options, "dof": 6}
    configuration = calibration_options.configuration_of(options, recorded)
    values: dict[str, Any] = configuration.model_dump()
    search = values["search"]
    search["rotation_deg"] = max(search["rotation_deg"], plan.rotation_deg + MARGIN_DEG)
    search["translation_m"] = max(search["translation_m"], plan.translation_m + MARGIN_M)
    # The experiment knows how far away its starts are, so the global search looks no farther.
    search["reach_deg"] = plan.rotation_deg + REACH_MARGIN_DEG
    search["reach_m"] = plan.translation_m + REACH_MARGIN_M
    try:
        return CalibrationConfig.model_validate(values)
    except ValidationError as error:
        raise UsageError(
            f"the search box must reach {MARGIN_DEG:g} deg and {MARGIN_M:g} m beyond the starts: {describe(error)}"
        ) from error


def subject_of(
    source: str,
    frames: int | None,
    loaded: window_cutting.LoadedWindow,
    plan: Plan,
    options: SolverOptions,
    camera_model: str | None,
    stages: Stages,
) -> Subject:
    """A loaded window with its depth. A plan for which the window is too short is refused before any depth is inferred.

    Raises:
        UsageError: a value that does not exist.
        CalibrationError: there are too few pairs for the detection that the plan asks for, or a frame has no depth.
    """
    window = loaded.window
    if plan.detection:
        require_enough(len(window.pairs))
    if camera_model is not None:
        window, _ = fit_camera(window, camera_model)
    if plan.steps and loaded.configuration is None:  # a recorded window brings the pairs between its own
        window = window_cutting.with_thinned_pairs(window, open_source(source), WindowConfig())
    model = open_depth(configuration_of(plan, options, loaded.configuration).depth, LimitsConfig())
    depth = solve_experiments.inferred(window, model, stages.begin("depth", len(window.pairs)))
    return Subject(source, frames, window, model, depth, loaded.configuration, loaded.vehicle)


def bench_of(subject: Subject, plan: Plan, options: SolverOptions) -> Bench:
    """What all solves share.

    Raises:
        UsageError: as `configuration_of`.
    """
    configuration = configuration_of(plan, options, subject.recorded)
    return Bench(subject.window, subject.depth, solve_experiments.greys_of(subject.window), configuration)


def tried(subject: Subject, plan: Plan, bench: Bench, stages: Stages) -> Experiments:
    """Runs every experiment of the plan. After Ctrl-C it returns those that were finished, unless not even one start
    was.

    Raises:
        CalibrationError: there is no result even when the search starts from the source's calibration.
        KeyboardInterrupt: on Ctrl-C before the first start was finished.
    """
    poses = solve_experiments.poses_of(bench, plan.directions, plan.rotation_deg, plan.translation_m)
    done = Experiments(solve_experiments.from_reference(bench, stages))
    try:
        for outcome in solve_experiments.from_starts(bench, poses, stages):
            done.outcomes.append(outcome)
        _try_further(done, subject, plan, bench, poses, stages)
    except KeyboardInterrupt:
        if not done.outcomes:
            raise
        done.interrupted = True
    return done


def _try_further(
    done: Experiments, subject: Subject, plan: Plan, bench: Bench, poses: Sequence[Matrix4], stages: Stages
) -> None:
    def cut(begin_s: float, end_s: float) -> Window:
        between_s = (begin_s, end_s)
        loaded = window_cutting.load_window(
            subject.source, subject.frames, WindowConfig().pairs, lambda *_: None, between_s
        )
        # The rig of the whole window stays, because its camera model may have been replaced.
        return replace(loaded.window, rig=subject.window.rig)

    if plan.against_frames:
        done.frames = solve_experiments.against_frames(bench, poses, stages)
    if plan.against_slice:
        done.slices = solve_experiments.against_slice(bench, subject.model, cut, poses, stages)
    radii = (radians(plan.rotation_deg), plan.translation_m)
    splits = plan.halves or plan.nees
    halved = solve_experiments.in_halves(bench, splits, *radii, stages) if splits else []
    if plan.halves:
        done.halves = solve_statistics.compare(halved, len(bench.window.pairs) // 2, bench.configuration.search.dof)
    if plan.nees:
        against, true_pose = _truth(subject.source, bench)
        starts = solve_experiments.poses_of(bench, plan.nees, plan.rotation_deg, plan.translation_m)
        outcomes = solve_experiments.in_windows(bench, subject.model, cut, starts, true_pose, stages)
        done.normalised[against] = solve_statistics.normalise(solve_statistics.of_outcomes(outcomes), len(outcomes))
        # Every split sees the same frames: they count as one.
        done.normalised[OTHER_HALF] = solve_statistics.normalise(solve_statistics.of_differences(halved), independent=1)
    if plan.detection:
        seen = solve_experiments.detected(bench, plan.detection, solve_experiments.CHECKS, stages)
        done.detection = evaluation_documents.detection_of(seen, plan.detection, len(bench.window.pairs))
    if plan.steps:
        done.steps = mount_steps.table(solve_experiments.mount_step_trials(bench, plan.steps, stages))


def _truth(source: str, bench: Bench) -> tuple[str, Callable[[int], Matrix4]]:
    """The reference for the errors of windows, as a name and a pose by stamp: the truth where the source knows it, else
    its own calibration."""
    recording = open_source(source)
    if isinstance(recording, HasGroundTruth):
        return SIMULATED_TRUTH, recording.truth
    return OWN_CALIBRATION, lambda _: bench.reference


def report_of(
    subject: Subject, plan: Plan, bench: Bench, done: Experiments, elapsed_s: dict[str, float]
) -> EvaluationReport:
    """The document of an evaluation.

    Raises:
        CalibrationError: there is no estimate even when the search starts from the source's calibration.
    """
    summary = solve_statistics.summarise(done.outcomes)
    search = bench.configuration.search
    solved = done.from_reference.trial.estimate
    if solved is None:
        raise CalibrationError("there is no estimate from the source's calibration itself")
    return EvaluationReport(
        source=subject.source,
        vehicle=subject.vehicle,
        pair=bench.window.rig.pair,
        window_id=bench.window.window_id,
        pairs=len(bench.window.pairs),
        camera_model=name_of(bench.window.rig.camera),
        objective=bench.configuration.objective.kind,
        dof=search.dof,
        start_rotation_deg=plan.rotation_deg,
        start_translation_m=plan.translation_m,
        search_rotation_deg=search.rotation_deg,
        search_translation_m=search.translation_m if search.dof == 6 else 0.0,
        hit_rotation_deg=degrees(solve_statistics.HIT_RAD),
        hit_translation_m=solve_statistics.HIT_M if search.dof == 6 else None,
        interrupted=done.interrupted,
        starts=summary.starts,
        hits=summary.hits,
        hit_rate=summary.hit_rate,
        rotation_deg=evaluation_documents.angle_spread_of(summary.rotation_rad),
        translation_m=evaluation_documents.spread_of(summary.translation_m),
        median=cast("Vector6", finite_degrees(summary.median)),
        bias=finite_degrees(summary.bias),
        std=finite_degrees(summary.std),
        rms=finite_degrees(summary.rms),
        sigma=finite_degrees(summary.sigma),
        from_reference=cast("Vector6", finite_degrees(done.from_reference.error)),
        solve_s=evaluation_documents.spread_of(summary.solve_s),
        evaluations=evaluation_documents.spread_of(summary.evaluations),
        classified_correctly=summary.classified_correctly,
        verdicts=summary.verdicts,
        stop_reasons=summary.stop_reasons,
        worst_start=solve_statistics.worst(done.outcomes),
        frames=done.frames,
        slices=done.slices,
        halves=None if done.halves is None else evaluation_documents.halves_of(done.halves),
        detection=done.detection,
        steps=done.steps,
        normalised=tuple(
            evaluation_documents.normalised_of(against, errors) for against, errors in done.normalised.items()
        ),
        depth_identity=solved.depth_identity,
        config_hash=solved.config_hash,
        elapsed_s=elapsed_s,
    )


class CallbackStages(Stages):
    """The stages of an evaluation, reported to a function instead of shown."""

    def __init__(self, progress: Progress | None) -> None:
        super().__init__(Bars(disable=True))
        self._progress = CallbackProgress(progress)

    def begin(self, stage: str, total: int | None) -> Callable[[int, str], None]:
        """See `Stages.begin`."""
        advance = super().begin(stage, total)

        def both(done: int, note: str = "") -> None:
            advance(done, note)
            self._progress.step(stage, done, total or 0)

        return both


def evaluate(
    window: PublicWindow | Recording,
    *,
    rotation_deg: float,
    translation_m: float = 0.0,
    directions: int = 200,
    halves: int = 0,
    detection: int = 0,
    **options: Unpack[SolverOptions],
) -> EvaluationReport:
    """Solves from many starts all around the recording's own calibration. The report says how often that calibration is
    recovered, how exactly, and how good the verdicts are. `coec evaluate` prints the same report and has further
    experiments.

    Args:
        window: the frames to solve with; a recording stands for its window of `frames` (25) camera frames.
        rotation_deg: radius of the sphere of starts, degrees.
        translation_m: the same for the translation, metres. Above 0, six degrees of freedom are searched unless `dof`
            says otherwise.
        directions: number of starts, spread evenly (a Fibonacci sphere).
        halves: also compare the results of disjoint halves of the frames, over this many random splits; 0: do not.
        detection: also measure how well checks detect a moved extrinsic, over this many splits of the frames; 0: do
            not.
        options: see `SolverOptions`.

    Returns:
        A pydantic model: `hit_rate`, `rotation_deg` and `translation_m` (median, p95, max), `bias`, `std`,
        `classified_correctly` and more, each explained in `schemas/v1/EvaluationReport.json`.

    Raises:
        UsageError: a value that does not exist, or starts farther away than any search box reaches.
        CalibrationError: there is no result even when the search starts from the recording's calibration.
        SourceError, WindowError, ModelError: as `calibrate`.
        KeyboardInterrupt: on Ctrl-C.
    """
    for name, value, least in (
        ("rotation_deg", rotation_deg, 0.0),
        ("translation_m", translation_m, 0.0),
        ("directions", directions, 1),
        ("halves", halves, 0),
        ("detection", detection, 0),
    ):
        if not value >= least:
            raise UsageError(f"{name}={value!r}: must be at least {least:g}")
    checked(options)
    progress, frames = options.get("progress"), options.get("frames")
    if isinstance(window, PublicWindow) and frames is not None:
        raise UsageError("frames: a window has its frames already; give the number to `Recording.window`")
    stages = CallbackStages(progress)
    cut = window.window(frames=frames, progress=progress) if isinstance(window, Recording) else window
    plan = Plan(rotation_deg, translation_m, directions, halves=halves, detection=detection)
    subject = subject_of(cut.source, cut.frames, cut.loaded, plan, options, options.get("camera_model"), stages)
    bench = bench_of(subject, plan, options)
    done = tried(subject, plan, bench, stages)
    if done.interrupted:
        raise KeyboardInterrupt
    return report_of(subject, plan, bench, done, stages.elapsed_s())
