"""A page of every kind, of made-up data: what browsers and readers are shown in tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np

from coec.calibration.baseline import PaperLimits
from coec.calibration.figures import FIGURES
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import LENS_DIRTY
from coec.calibration.types import (
    CameraFrame,
    Decision,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Metric,
    Reason,
    Window,
)
from coec.io.serialise import result_of
from coec.reports import fleet_page, incident_page
from coec.reports.calibration import calibration_page
from coec.reports.diagnosis import baselines_page, check_page
from coec.reports.incident_page import FetchedIncident
from coec.reports.page import Compare, Page, Pictures
from coec.reports.page_parts import Provenance, file_picture
from coec.reports.pictures import slid_pictures
from coec.schemas.documents import (
    Absent,
    DayOfPair,
    FalseAlarms,
    FetchedWindow,
    FigureOfFleet,
    FleetReport,
    PairOfFleet,
)
from coec.schemas.replies import (
    CalibrationReport,
    CalibrationResult,
    ChainedEntry,
    EvidenceEvent,
    HistoryEntry,
    HistoryReply,
    MetricsPoint,
)
from coec.schemas.replies import Reason as Said
from coec_lab.demo import rig as rig_of_demo
from coec_lab.demo import rig as rig_vehicle
from coec_lab.demo.pair_client import Moment, outcome_of
from coec_lab.demo.pair_report import demo_page
from coec_lab.experiments import evaluation_charts, evaluation_page, paper_figures
from coec_lab.experiments.evaluation_charts import bullseye
from coec_lab.experiments.evaluation_page import detection_page
from coec_lab.experiments.evaluation_schema import (
    ComparisonReport,
    DetectionReport,
    DetectionRow,
    EvaluationReport,
    FramesPoint,
    HalvesReport,
    NormalisedErrorsReport,
    Spread,
    StepRow,
    VerdictCounts,
)
from coec_lab.experiments.objective_scans import Scan, Views
from coec_lab.experiments.paper_figures import MOVES_DEG, FailureFigures, Plots, paper_page
from coec_lab.experiments.solve_experiments import sphere_directions
from coec_lab.experiments.solve_statistics import HIT_RAD, SolveOutcome, Trial
from support.estimates import ESTIMATE_RIG, a_baseline, estimate

EVIL = "<script>alert(1)</script>'\"><img src=http://evil/x onerror=alert(2)>"
MADE = Provenance("coec calibrate window.mcap --output out", 1_760_000_000 * 10**9, {"coec": "0.1.0"}, "Linux x86_64")
S = 1_000_000_000
HASH = "3f786850e387550fdab836ed7e6dc881de23001b3f786850e387550fdab836ed"


def png(width: int = 160, height: int = 90, seed: int = 0) -> bytes:
    """A picture that is no surface of one colour."""
    image = np.random.default_rng(seed).integers(0, 255, (height // 10, width // 10, 3), dtype=np.uint8)
    return bytes(cv2.imencode(".png", cv2.resize(image, (width, height)))[1])


def files(folder: Path, *names: str) -> list[Path]:
    """Pictures on the disk."""
    paths = [folder / f"{name}.png" for name in names]
    for number, path in enumerate(paths):
        path.write_bytes(png(320, 180, number))
    return paths


def window() -> Window:
    """Two pairs of nothing much."""
    pairs = tuple(
        FramePair(
            CameraFrame(stamp, "camera", EncodedImage(ImageFormat.PNG, 160, 90, png(seed=stamp))),
            LidarFrame(stamp, "lidar", np.full((2, 3), stamp, np.float32)),
        )
        for stamp in (S, 2 * S)
    )
    return Window("front-2", ESTIMATE_RIG, ESTIMATE_RIG.T_camera_lidar_nominal, pairs)


def metrics_of(*, accepted: bool) -> tuple[Metric, ...]:
    """Every figure there is; half of them fail where it is refused."""
    return tuple(
        Metric(name, 1.5 if accepted or number % 2 else 0.5, 1.0, at_least=True) for number, name in enumerate(FIGURES)
    )


def result(*, accepted: bool = True, vehicle: str = "truck") -> CalibrationResult:
    """Of a window."""
    made, metrics = estimate(2 * S), metrics_of(accepted=accepted)
    reasons = () if accepted else tuple(Reason(m.name, f"{m.name} says no") for m in metrics if not m.passed)
    decision = Decision.ACCEPTED if accepted else Decision.FAILED
    verdict = replace(made.verdict, decision=decision, metrics=metrics, reasons=reasons)
    return result_of(replace(made, verdict=verdict), ESTIMATE_RIG, vehicle)


def calibration_report(*, accepted: bool = True, vehicle: str = "truck") -> CalibrationReport:
    """What `coec calibrate` prints of it."""
    sigma = (0.031, 0.0284, 0.05, None, None, None)
    reported = {**dict(result(accepted=accepted, vehicle=vehicle)), "sigma": sigma}
    return CalibrationReport(**reported, elapsed_s={"load": 0.5, "search": 2.5, "total": 3.0})


def calibration(folder: Path, *, accepted: bool = True, vehicle: str = "truck") -> Page:
    """Of `coec calibrate`, with pictures."""
    blocks = (compared(), Pictures(tuple(map(file_picture, files(folder, "close_ups", "lens_residual")))))
    report = calibration_report(accepted=accepted, vehicle=vehicle)
    return calibration_page(report, window(), (1.0, 0.0, -2.0, 0.0, 0.0, 0.0), blocks, ["a remark"], MADE)


def compared() -> Compare:
    """Two pictures in one place."""
    noise = np.random.default_rng(3).integers(0, 255, (2, 180, 320, 3), dtype=np.uint8)
    return slid_pictures((noise[0], noise[1]), ("Before: start.", "After: result."))


SPREAD = Spread(median=0.04, p95=0.21, max=3.7)
AXES = (0.011, -0.02, 0.04, 0.003, -0.0021, 0.01)
HALVES = HalvesReport(
    splits=4, pairs=12, solved=4, accepted=3, hits=4, rms=AXES, largest=AXES, sigma=AXES, claimed=(4, 4, 4, 4, 4, 4),
    covered=(1.0, 1.0, 0.75, 1.0, 1.0, 1.0),
)  # fmt: skip
NORMALISED = NormalisedErrorsReport(
    against="the simulated truth", judged=40, refused=2, independent=8, rms=AXES, largest=AXES, sigma=AXES,
    sigma_over_rms=AXES, within_1_sigma=(0.7,) * 6, within_2_sigma=(0.96,) * 6, within_3_sigma=(1.0,) * 6,
    bin_edges=(-2.0, -1.0, 1.0, 2.0), histogram=((1, 2, 3),) * 6, confidences=(0.5, 0.9),
    reliability=((0.5, None),) * 6, nees=1.1, nees_low=0.6, nees_high=1.5,
)  # fmt: skip
DETECTION = DetectionReport(
    splits=3,
    pairs=24,
    moves=tuple(
        DetectionRow(
            name=name, checks=60, flagged=share, flagged_low=share / 2, flagged_high=min(1.0, share + 0.1),
            undecided=0.05, flagged_by_paper=share / 3,
        )
        for name, share in (("right", 0.01), ("0.5 deg", 0.62), ("1 deg", 0.99))
    ),
)  # fmt: skip


OUTCOMES = [
    SolveOutcome(Trial(np.eye(4), None, 1.0), np.eye(4), np.array([*error, 0.0, 0.0, 0.0]),
            float(np.linalg.norm(error)), 0.0, float(np.linalg.norm(error)) / HIT_RAD, bool(accepted))
    for error, accepted in zip(
        np.radians(np.random.default_rng(2).normal(0.0, 0.4, (12, 3))), (True, False) * 6, strict=True
    )
]  # fmt: skip
ENDS = bullseye({"": OUTCOMES}, {"rotation vectors of the starts": sphere_directions(12)})
SCANS = tuple(Scan(axis, np.linspace(-0.1, 0.1, 21), np.cos(np.linspace(-2.0, 2.0, 21))) for axis in range(6))
VIEWS = Views(SCANS, SCANS)


def evaluation_report(objective: str = "fused", accepted_misses: int = 0) -> EvaluationReport:
    """With every experiment."""
    points = tuple(
        FramesPoint(frames=n, subsets=8, hit_rate=0.5, rotation_deg=Spread(median=1 / n, p95=3 / n, max=9 / n),
                    translation_m=SPREAD, sigma_deg=0.7 / n)
        for n in (1, 2, 5, 10, 25)
    )  # fmt: skip
    steps = StepRow(
        name="0.5 deg", windows=8, accepted=0.1, wrong=0.0, moved=0.9, time_known=1.0, off_s=0.4, told_s=2.0, holds=1.0
    )
    return EvaluationReport(
        source="sim:seed=1", vehicle="truck", pair="front", window_id="front-2", pairs=25, camera_model="double_sphere",
        objective=objective, dof=6, start_rotation_deg=5.0, start_translation_m=0.1, search_rotation_deg=10.0,
        search_translation_m=0.3, hit_rotation_deg=0.5, hit_translation_m=0.2, starts=40, hits=38, hit_rate=0.95,
        rotation_deg=SPREAD, translation_m=SPREAD, median=AXES, bias=AXES, std=AXES, rms=AXES, sigma=AXES,
        from_reference=AXES, solve_s=SPREAD, evaluations=SPREAD, classified_correctly=0.95,
        verdicts=VerdictCounts(accepted_hits=38, accepted_misses=accepted_misses, failed_hits=0, failed_misses=2),
        stop_reasons={"tolerance_reached": 40}, worst_start=3, frames=points, slices=(), halves=HALVES,
        detection=DETECTION, steps=(steps,), normalised=(NORMALISED,), depth_identity=HASH, config_hash="ab" * 8,
        elapsed_s={"load": 1.0, "total": 80.0},
    )  # fmt: skip


def evaluation(folder: Path, accepted_misses: int = 0) -> Page:
    """Of `coec evaluate`."""
    del folder
    ends = (ENDS, evaluation_charts.landscape({"fused": VIEWS, "mi": VIEWS}))
    report = evaluation_report(accepted_misses=accepted_misses)
    return evaluation_page.evaluation_page(report, ends, (compared(),), MADE)


def comparison(folder: Path) -> Page:
    """Of `coec evaluate --objective all`."""
    methods = {name: evaluation_report(name) for name in ("fused", "mi")}
    report = ComparisonReport(
        source="sim:seed=1", methods=methods, not_evaluated={"intensity": "no cloud has intensity"}, elapsed_s={}
    )
    del folder
    return evaluation_page.comparison_page(report, (ENDS,), MADE)


def paper(folder: Path) -> Page:
    """Of `coec paper`."""
    figures: dict[str, Any] = {
        "runs": 100, "hits": 41, "classified_correctly": 1.0, "mean_deg": [0.1, -0.02, 0.1], "std_deg": [0.1, 0.2, 0.1]
    }  # fmt: skip
    document = {
        "source": "sim:seed=1",
        "objective": "mi",
        "pairs": 25,
        "failure_metrics": {
            "moves": [{"moved_deg": moved, "checks": 100, "flagged": moved / 3} for moved in (0.0, 1.0, 3.0)]
        },
        "bullseye": {"start_deg": 25.0, **figures},
        "drive": [{"start_deg": radius, **figures} for radius in paper_figures.ERRORS_DEG],
        "run_times": [{"frames": frames, "mi_ms": 1.23, "solve_ms": 200.0} for frames in (5, 8)],
    }
    del folder
    rng = np.random.default_rng(4)
    figures_at = [FailureFigures(moved, *rng.normal(5.0 - moved, 1.0, 3)) for moved in MOVES_DEG for _ in range(20)]
    plots = Plots(
        evaluation_charts.failure_figures(figures_at, PaperLimits(3.0, 4.0, 5.0)),
        ENDS,
        evaluation_charts.drive({"from 5°": [(float(second), outcome) for second, outcome in enumerate(OUTCOMES)]}),
    )
    return paper_page(document, plots, MADE)


def observation(**changes: Any) -> Observation:
    """A check that found nothing wrong."""
    seen = Observation(
        stamp_ns=2 * S, pair_stamps_ns=(S, 2 * S), metrics=metrics_of(accepted=True), offset=np.full(6, 0.001),
        sigma=np.full(6, 0.002), noise=np.full(6, 0.002), place=np.full(6, 0.001), dispersion=1.0, distance2=0.3,
        flagged=False, undecided=False, weak=False, flagged_by_paper=None, causes=(), drift=None,
        first_derivative=np.full(6, 0.5), second_derivative=np.full(6, 20.0),
    )  # fmt: skip
    return replace(seen, **changes)


def check(folder: Path, **changes: Any) -> Page:
    """Of `coec diagnose`."""
    return check_page(observation(**changes), None, window(), HASH, "ab" * 8, files(folder, "overlay"), MADE)


def flagged(folder: Path) -> Page:
    """Of a mount that is off."""
    return check(folder, flagged=True, metrics=metrics_of(accepted=False), offset=np.full(6, 0.02))


def dirty(folder: Path) -> Page:
    """Of a camera that cannot tell."""
    return check(folder, causes=(LENS_DIRTY,))


def detection(_: Path) -> Page:
    """Of `coec diagnose --detection`."""
    return detection_page(DETECTION, "sim:seed=1", MADE)


def baseline(_: Path) -> Page:
    """Of `coec commission`, with another pair in the file."""
    pairs = {"front": a_baseline(), "rear": replace(a_baseline(), pair="rear")}
    return baselines_page(pairs, "front", ["sim:seed=1"], "rig.json", MADE)


def incident(_: Path, vehicle: str = "truck") -> Page:
    """Of `coec fetch`, with all that may come home."""
    metrics = tuple(
        MetricsPoint(
            stamp_ns=(80 + at) * S,
            state="healthy" if at < 20 else "suspect" if at < 30 else "miscalibrated",
            metrics={name: float(np.sin(at + number)) for number, name in enumerate(FIGURES)},
        )
        for at in range(0, 60, 5)
    )
    refused = result(accepted=False, vehicle=vehicle)
    event = EvidenceEvent(
        event_id="front-100", vehicle=vehicle, pair="front", stamp_ns=110 * S, wall_ns=1_700_000_000 * S,
        reasons=(Said(code="bent_mount", text="The mount is bent."),), camera_from_lidar=refused.camera_from_lidar,
        window_before=refused.window_id, metrics=metrics,
    )  # fmt: skip
    entry = HistoryEntry(
        sequence=0, previous_sha256=HASH, kind="command", code="applied", text=vehicle, wall_ns=S, sender=vehicle
    )
    history = HistoryReply(
        vehicle=vehicle, pair="front", total=1, results=(refused,), entries=(ChainedEntry(sha256=HASH, entry=entry),)
    )
    fetched = FetchedWindow(
        window_id="front-7", sha256=HASH, size_bytes=20_000_000, pairs=12, decision="accepted", in_history=False
    )
    absent = (Absent(what="status.json", why="it did not answer"),)
    story = FetchedIncident(event, history, None, None, None, (fetched,), absent, False, ("front-7.snippet",))
    return incident_page.page(story, {"before.jpg": png(320, 180), "after.jpg": png(320, 180, 1)}, MADE)


def fleet(_: Path, vehicle: str = "shuttle") -> Page:
    """Of `coec fleet report`."""
    days = tuple(
        DayOfPair(date=f"2026-11-{day:02}", windows=3, low=(day / 20 - 0.2,) * 6, middle=(day / 20,) * 6,
                  high=(day / 20 + 0.1,) * 6)
        for day in range(1, 29)
    )  # fmt: skip
    pairs = tuple(
        PairOfFleet(
            vehicle=f"{vehicle}-{number}", pair="front", windows=84, accepted=80, errors=0, last_ns=10**18,
            latest=AXES, drift=(1.2 - number / 3,) + (0.0,) * 5, slope=(0.3,) * 6, worst="rx_deg",
            urgency=max(2.4 - number, 0.0), days=days,
        )
        for number in range(4)
    )  # fmt: skip
    alarms = FalseAlarms(
        pairs=4, watched_h=50.0, confirmed=1, withdrawn=1, per_100_h=2.0, per_100_h_at_most=9.4,
        by_pair={f"{vehicle}-1/front": 1},
    )  # fmt: skip
    figures = (FigureOfFleet(name="runner_up", pair="front", vehicles=4, windows=320, low=0.2, middle=0.4, high=0.7),)
    report = FleetReport(
        vehicles=4, pairs=pairs, windows=336, accepted=320, refusals={"runner_up": 16}, errors={}, first_ns=S,
        last_ns=10**18, figures=figures, changes=None, false_alarms=alarms,
    )  # fmt: skip
    return fleet_page.page(report, f"Fleet of {vehicle}", MADE)


MOMENTS = tuple(
    Moment(
        t_s=3.0 + second, drive_s=second, service="running", health=health, provenance=provenance, status="accepted",
        window_id=None, correction_deg=(0.0, 0.0, 0.0), error_by_axis_deg=(0.0, 0.0, 0.0), error_deg=error_deg,
    )
    for second, health, provenance, error_deg in (
        (0.0, "unknown", "nominal", 0.9),
        (28.0, "healthy", "estimated", 0.04),
        (36.5, "healthy", "estimated", 3.01),
        (46.0, "suspect", "estimated", 3.01),
        (51.0, "miscalibrated", "estimated", 3.01),
        (61.0, "healthy", "estimated", 0.06),
    )
)  # fmt: skip


def demo(folder: Path) -> Page:
    """Of `coec demo`."""
    series = [(moment.drive_s, moment.error_deg, moment.health) for moment in MOMENTS] + [(75.0, 0.06, "healthy")]
    happened = [(moment, "alarm" if moment.health == "miscalibrated" else "") for moment in MOMENTS]
    outcome = outcome_of(MOMENTS, 36.0, 0.25)
    return demo_page(
        "A knocked mount",
        series,
        happened,
        [("knock", "3°")],
        outcome,
        result(),
        compared(),
        folder / "sim-1.mcap",
        MADE,
    )


def rig_demo(folder: Path) -> Page:
    """Of `coec demo --rig`."""
    scenario = rig_vehicle.SCENARIO
    act = scenario.acts[0]
    names = {scenario.lidar: "lidar", "front": "camera", "left": "camera", "rear": "camera", "right": "camera"}
    snapshots = [
        rig_vehicle.RigSnapshot(
            second=second,
            checked="roof_front",
            sensors={
                name: rig_vehicle.SensorCondition(
                    name, kind, "lidar_moved" if moved and kind == "lidar" else "calibrated",
                    1.0 if moved and kind == "lidar" else 0.0, None, f"{name} is as it was",
                )
                for name, kind in names.items()
            },
            edges={},
        )
        for second, moved in ((4.0, False), (scenario.knock_s + 9.0, True))
    ]  # fmt: skip
    outcome = rig_vehicle.outcome_of(act, snapshots, scenario.knock_s)
    return rig_of_demo.page(files(folder, "lidar_knocked"), [(outcome, snapshots)], MADE, scenario)


KINDS: Mapping[str, Callable[[Path], Page]] = MappingProxyType(
    {
        "calibration": calibration,
        "refusal": lambda folder: calibration(folder, accepted=False),
        "evaluation": evaluation,
        "comparison": comparison,
        "paper": paper,
        "check": check,
        "flagged": flagged,
        "dirty": dirty,
        "detection": detection,
        "baseline": baseline,
        "incident": incident,
        "fleet": fleet,
        "demo": demo,
        "rig_demo": rig_demo,
        "hostile_calibration": lambda folder: calibration(folder, vehicle=EVIL),
        "hostile_incident": lambda folder: incident(folder, EVIL),
        "hostile_fleet": lambda folder: fleet(folder, EVIL),
    }
)
"""Every kind of page, and what is said by somebody who means ill."""
