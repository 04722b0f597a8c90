"""What a program that imports coec asks for."""

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
    """Finds where the camera is to the LiDAR, and judges what it found. The same window, network and configuration give
    the same result, to the byte, and the one that `coec calibrate` prints. Whether to use it, `Result.accepted` says:
    a negative verdict is a result, and no error.

    Args:
        window: what is calibrated from; of a recording, its window of 25 frames.
        depth: an ONNX file, the name of a built-in network, or `stereo`: the maps of the recording. None: what a
            recorded window names, else the network that comes with coec.
        objective: what is maximised: `fused` (edges and depth), `mi` (the paper's), `intensity`. None: as recorded,
            else `fused`.
        dof: 3, rotation only, or 6, translation too. None: as recorded, else 3.
        perturb: (3,) degrees about, or (6,) degrees about and metres along the camera axes, by which the start is moved
            from the recording's calibration: exp(perturb)·T.
        motion_compensation: False takes the sweeps as they were recorded.
        camera_model: `double_sphere` is fitted to the recording's camera, and used instead. None: the recording's own.
        time_offset: also estimate how far the camera's clock is off, if turns show it.
        configuration: all that decides a result, instead of what was recorded and the defaults; what is given besides
            comes first.
        progress: is called with (stage, parts done, parts of all) while it goes on; 0 where that is not known.

    Raises:
        UsageError: a value that does not exist.
        SourceError, WindowError: the recording cannot be read.
        ModelError: the depth network is missing, corrupt, or does not match its card.
        CalibrationError: there is no result at all: no pairs, no depth, or no point that can come into view.

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
    """Solves from many starts all around the recording's own calibration: how often it is found again, how exactly, and
    how good the verdicts are. `coec evaluate` prints the same report, and knows further experiments.

    Args:
        window: what is solved; of a recording, its window of 25 frames.
        rotation_deg: radius of the sphere of starts, degrees.
        translation_m: the same, metres; above 0 six degrees of freedom are searched unless `dof` says otherwise.
        directions: number of starts, spread evenly (a Fibonacci sphere).
        halves: also split the frames so often at random into disjoint halves, and compare their results.
        detection: also say how well moved extrinsics are seen, over so many splits of the frames.
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
        UsageError: a value that does not exist, or starts too far for any search box.
        CalibrationError: there is no result even from the recording's calibration.
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
            raise UsageError(f"{name}={value!r}: at least {least:g}")
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
