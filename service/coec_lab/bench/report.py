"""The whole benchmark and its table: each figure next to its required bound."""

import os
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from coec.reports import console
from coec_lab.bench import daemon, kernels, processes
from coec_lab.simulation.source import require_embree


@dataclass(frozen=True, slots=True)
class Row:
    """A figure by its name in the document. `required` bounds it from above, or a ratio from below."""

    key: str
    work: str
    unit: str
    digits: int = 1
    required: float | None = None

    @property
    def at_least(self) -> bool:
        """Whether more is better."""
        return self.unit == "×"

    def met(self, value: float) -> bool:
        """Whether the figure meets its bound; without a bound it does."""
        if self.required is None:
            return True
        return value >= self.required if self.at_least else value <= self.required


OFF_DEG = 0.2
"""The time of a solve counts only if it ends this near to the truth: two of the standard deviations that the fused
solve claims, 0.06 to 0.11°, rounded."""

ROWS: tuple[Row, ...] = (
    Row("mi_25_frames_ms", "one MI, 25 frames of 114,000 points", "ms", 2, 2.5),
    Row("mi_25_frames_nothing_left_out_ms", "the same, free to turn anywhere", "ms", 2),
    Row("ratio_to_numpy", "times as fast as NumPy", "×", 0, 40.0),
    Row("ratio_to_scalar", "times as fast as a scalar compiled loop", "×", 1, 8.0),
    Row("mi_25_frames_ms_by_model", "camera", "ms", 2, 2.5),
    Row("mi_ms_by_frames", "frames", "ms", 2),
    Row("mi_per_frame_spread_percent", "time of one frame, farthest of these from their mean", "%", 0, 15.0),
    Row("solve_10deg_3dof_s", "MI solve, 3 axes, from 10°", "s", 3, 0.25),
    Row("solve_10deg_3dof_error_deg", "MI solve: error of its result", "°", 3, OFF_DEG),
    Row("solve_25deg_6dof_s", "fused solve, 6 axes, from 25°, without depth", "s", 2, 0.8),
    Row("solve_25deg_6dof_error_deg", "fused solve: error of its result", "°", 3, OFF_DEG),
    Row("look_1400_cpu_ms", "a check of six pairs, 1400 px: processor", "ms", 0, 120.0),
    Row("look_700_cpu_ms", "a check of six pairs, 700 px: processor", "ms", 0, 60.0),
    Row("look_off_deg", "error of these checks, image of px", "°", 3, OFF_DEG),
    Row("worker_first_result_s", "worker: start to first result", "s", 2, 2.0),
    Row("worker_window_s_mi", "worker: a window of 25 frames, MI, with depth and files", "s", 2),
    Row("worker_window_s_fused", "worker: the same, fused", "s", 2),
    Row("solve_memory_mb_mi", "worker: memory of that above idle, MI", "MB", 0, 300.0),
    Row("solve_memory_mb_fused", "worker: memory of that above idle, fused", "MB", 0, 300.0),
    Row("recording_cpu_percent", "writing windows at 35 MB/s with lz4, of one core", "%", 1, 20.0),
    Row("io_cpu_percent", "I/O process under load, of one core", "%", 1, 25.0),
    Row("io_resident_mb", "I/O process under load, most resident memory (RSS)", "MB", 0, 250.0),
    Row("io_proportional_mb", "I/O process under load, its share of it (PSS)", "MB", 0),
    Row("ros_io_cpu_percent", "the same load as CDR on topics of ROS, of one core", "%", 1, 12.0),
    Row("ros_io_resident_mb", "CDR on topics of ROS, most resident memory (RSS)", "MB", 0, 200.0),
    Row("ros_io_proportional_mb", "CDR on topics of ROS, its share of it (PSS)", "MB", 0),
    Row("query_during_solve_p50_ms", "query during solves, median", "ms", 2, 1.5),
    Row("query_during_solve_p99_ms", "query during solves, 99th percentile", "ms", 2, 8.0),
    Row("query_idle_p99_ms", "query while the worker waits, 99th percentile", "ms", 2),
    Row("rig_cpu_percent", "four fisheyes 1400² and a LiDAR at 10 Hz, all processes, of one core", "%", 1, 60.0),
    Row("rig_io_cpu_percent", "of that the I/O process", "%", 1, 20.0),
    Row("rig_resident_mb", "its most resident memory (RSS)", "MB", 0, 490.0),
    Row("rig_worker_s", "of that the worker, a minute", "s", 2),
    Row("rig_unseen_s", "longest time that a pair was not checked", "s", 1, 15.0),
    Row("large_rig_cpu_percent", "eight fisheyes 700² and three LiDARs, 24 pairs, all processes, of one core", "%", 1),
    Row("large_rig_io_cpu_percent", "of that the I/O process", "%", 1),
    Row("large_rig_resident_mb", "its most resident memory (RSS)", "MB", 0, 730.0),
    Row("large_rig_worker_resident_mb", "that of the worker", "MB", 0),
    Row("large_rig_wanted_cores", "what every check and every window would take, of a core", "", 2),
    Row("large_rig_unseen_s", "longest time that one of these pairs was not checked", "s", 1),
)
"""The rows in their order. A figure that is a mapping becomes a row for each of its entries."""


def run(*, as_json: bool) -> int:
    """Measures and prints the table; always returns 0: a figure that misses its requirement is marked, but there is no
    verdict.

    Raises:
        SourceError: the library that renders the street of one of the solves is not installed.
    """
    require_embree()
    with console.progress(counted=False) as bars:
        document = {"machine": _machine()} | kernels.measure(bars, kernels.Size()) | measure_processes(bars)
    console.report(document, lambda: _show(document), as_json=as_json)
    return 0


def measure_processes(bars: Progress) -> dict[str, Any]:
    """The figures of whole processes, by their names in `ROWS`: worker and daemon, one after the other.

    Raises:
        CalibrationError: the worker reached no result.
        ConnectionFailedError: the daemon did not become ready.
    """
    task = bars.add_task("processes", total=None, note="")

    def on_step(text: str) -> None:
        bars.update(task, description=text)

    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document = processes.measure_worker(Path(folder), kernels.FRAMES, on_step)
    document |= processes.measure_recording(on_step)
    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document |= daemon.measure_native(Path(folder), on_step) | daemon.measure_ros(Path(folder), on_step)
    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document |= daemon.measure_rigs(Path(folder), on_step)
    return document | {"required": required()}


def table(document: Mapping[str, Any]) -> Table:
    """The measured figures next to the required bounds."""
    shown = console.table("work", "figure", "required", "", right=(1, 2))
    for row in ROWS:
        value = document.get(row.key)
        figures = value.items() if isinstance(value, Mapping) else ((None, value),)
        for name, figure in figures:
            work = row.work if name is None else f"  {row.work} {name}"
            if figure is None:
                shown.add_row(work, "-", _bound(row), "")
                continue
            shown.add_row(work, f"{figure:.{row.digits}f} {row.unit}", _bound(row), _mark(row, figure))
    return shown


def required() -> dict[str, float]:
    """The bounds by the names of their figures."""
    return {row.key: row.required for row in ROWS if row.required is not None}


def _bound(row: Row) -> str:
    return "" if row.required is None else f"{'≥' if row.at_least else '≤'} {row.required:g} {row.unit}"


def _mark(row: Row, figure: float) -> Text:
    if row.required is None:
        return Text("")
    return Text("✓", "green") if row.met(figure) else Text("✗", "red")


def _machine() -> dict[str, Any]:
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": numba.get_num_threads(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numba": numba.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _show(document: dict[str, Any]) -> None:
    machine = document["machine"]
    console.show(
        f"{machine['processor']}, {machine['threads']} threads, Python {machine['python']}, numba {machine['numba']}"
    )
    console.out.print(table(document))
    received = ", ".join(f"{figure:.1f} {name}" for name, figure in document["io_per_second"].items())
    console.show(f"the load, a second: {received}")
