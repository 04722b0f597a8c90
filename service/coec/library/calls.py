"""The functions that a program calls which imports coec."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

from coec.config import CalibrationConfig
from coec.errors import UsageError
from coec.library.choices import Choices, Options
from coec.library.evaluating import Plan, bench_of, report_of, subject_of, tried
from coec.library.progress import Progress, ToldStages
from coec.library.recordings import Recording
from coec.library.results import Result
from coec.library.windows import Window
from coec.schemas.evaluation import EvaluationReport


def calibrate(
    window: Window | Recording,
    *,
    depth: str | PathLike[str] | None = None,
    objective: str | None = None,
    dof: int | None = None,
    perturb: Sequence[float] | None = None,
    motion_compensation: bool | None = None,
    camera_model: str | None = None,
    time_offset: bool = False,
    configuration: CalibrationConfig | None = None,
    progress: Progress | None = None,
) -> Result:
    """Finds the pose of the camera against the LiDAR, and judges the result. The same window, network and configuration
    give the same result, to the byte; `coec calibrate` prints the same one. `Result.accepted` says whether to use it:
    a negative verdict is a result, not an error.

    Args:
        window: the frames to calibrate from; a recording stands for its window of 25 frames.
        depth: an ONNX file, the name of a built-in network, or `stereo`: the depth maps of the recording. None: what a
            recorded window names, else the network that comes with coec.
        objective: what the search maximises: `fused` (edges and depth), `mi` (the paper's), `intensity`. None: as
            recorded, else `fused`.
        dof: 3, rotation only, or 6, translation too. None: as recorded, else 3.
        perturb: moves the start away from the recording's calibration: exp(perturb)·T. (3,) degrees about the camera
            axes, or (6,) degrees about and metres along them.
        motion_compensation: False: the sweeps are used as they were recorded.
        camera_model: `double_sphere`: this model is fitted to the recording's camera and used in its place. None: the
            recording's own.
        time_offset: also estimate how far the camera's clock is off, if the vehicle's turns show it.
        configuration: all settings that decide a result, in place of the recorded ones and the defaults. The other
            arguments override it.
        progress: is called with (stage, parts done, number of parts) on the way; the number is 0 while it is unknown.

    Raises:
        UsageError: a value that does not exist.
        SourceError, WindowError: the recording cannot be read.
        ModelError: the depth network is missing, corrupt, or does not match its card.
        CalibrationError: there is no result at all: no pairs, no depth, or no point that any pose brings into view.

    Example:
        >>> import coec
        >>> drive = coec.open("sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes")
        >>> result = coec.calibrate(drive, depth="stereo", objective="mi", perturb=(-2.0, 1.5, 1.0))
        >>> result.accepted, result.T_camera_lidar.shape
        (True, (4, 4))
        >>> bool(abs(result.correction[:3]).max() < 0.35)  # degrees from the simulated truth
        True
    """
    options: Options = {
        "depth": depth,
        "objective": objective,
        "dof": dof,
        "perturb": perturb,
        "motion_compensation": motion_compensation,
        "camera_model": camera_model,
        "time_offset": time_offset,
        "configuration": configuration,
        "progress": progress,
    }
    return window.calibrate(**options)


def evaluate(
    window: Window | Recording,
    *,
    rotation_deg: float,
    translation_m: float = 0.0,
    directions: int = 200,
    halves: int = 0,
    detection: int = 0,
    depth: str | PathLike[str] | None = None,
    objective: str | None = None,
    dof: int | None = None,
    motion_compensation: bool | None = None,
    camera_model: str | None = None,
    progress: Progress | None = None,
) -> EvaluationReport:
    """Solves from many starts all around the recording's own calibration. The report says how often that calibration is
    found again, how exactly, and how good the verdicts are. `coec evaluate` prints the same report and has further
    experiments.

    Args:
        window: the frames to solve with; a recording stands for its window of 25 frames.
        rotation_deg: radius of the sphere of starts, degrees.
        translation_m: the same for the translation, metres. Above 0, six degrees of freedom are searched unless `dof`
            says otherwise.
        directions: number of starts, spread evenly (a Fibonacci sphere).
        halves: also compare the results of disjoint halves of the frames, over this many random splits; 0: do not.
        detection: also measure how well checks detect a moved extrinsic, over this many splits of the frames; 0: do
            not.
        depth: as `calibrate`.
        objective: as `calibrate`.
        dof: as `calibrate`.
        motion_compensation: as `calibrate`.
        camera_model: as `calibrate`.
        progress: as `calibrate`.

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
    stages = ToldStages(progress)
    cut = window.window(progress=progress) if isinstance(window, Recording) else window
    plan = Plan(rotation_deg, translation_m, directions, halves=halves, detection=detection)
    chosen = Choices.of(
        {"depth": depth, "objective": objective, "dof": dof, "motion_compensation": motion_compensation}
    )
    subject = subject_of(cut.source, cut.frames, cut.loaded, plan, chosen, camera_model, stages)
    bench = bench_of(subject, plan, chosen)
    done = tried(subject, plan, bench, stages)
    if done.interrupted:
        raise KeyboardInterrupt
    return report_of(subject, plan, bench, done, stages.elapsed_s())
