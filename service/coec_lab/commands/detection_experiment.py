"""`coec diagnose --detection`: how well moved extrinsics are detected on a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coec.cli.commission import RigWindows
    from coec.reports.console import StageTimes
    from coec_lab.experiments.evaluation_schema import DetectionReport


def measure(rigged: RigWindows, splits: int, checks: int, times: StageTimes) -> DetectionReport:
    """Tries checks of moved extrinsics on the first window, over `splits` splits of its pairs.

    Raises:
        CalibrationError: the window has too few pairs, or a frame has no depth.
    """
    from coec.calibration.commissioning import FAR_RAD
    from coec.calibration.monitor.check import gather
    from coec.calibration.solver import prepare_window_data
    from coec_lab.experiments.detection import try_detection
    from coec_lab.experiments.evaluation_documents import detection_of

    window = rigged.windows[0]
    evidence = gather(prepare_window_data(window, rigged.depth, rigged.images, rigged.configuration, times), FAR_RAD)
    tried = try_detection(
        evidence,
        window.T_camera_lidar_start,
        rigged.configuration,
        splits,
        checks,
        lambda done, total: times.step("splits", done, total),
    )
    return detection_of(tried, splits, len(evidence.pairs))


def show(report: DetectionReport, source: str, output: Path | None, *, as_json: bool) -> None:
    """Prints the report, and writes its page into the folder `output`.

    Raises:
        OutputError: the page cannot be written.
    """
    from coec.reports import console, page
    from coec.reports.page_parts import Provenance
    from coec_lab.experiments.evaluation_page import detection_page
    from coec_lab.experiments.evaluation_tables import detection_table

    if output is not None:
        page.write(output / "report.html", detection_page(report, source, Provenance.here()))
    console.report(
        {"source": source, **report.model_dump(mode="json")},
        lambda: console.show_block(detection_table(report)),
        as_json=as_json,
    )
