"""`coec batch`: evaluates many windows again and writes tables."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from coec.cli.options import Json
from coec.errors import UsageError
from coec.reports import console
from coec.reports.console import PlainColumn
from coec.reports.formatting import count

if TYPE_CHECKING:
    from coec.fleet.worker_pool import Engine, WorkerLimits
    from coec.schemas.documents import BatchReport, WindowRow

MIB = 2**20

LINE_S = 30.0
"""Time between two lines of progress where standard error is no terminal."""

Windows = Annotated[
    list[str],
    typer.Argument(
        metavar="WINDOW...", help="Windows (.mcap), folders or patterns, as paths or URLs.", show_default=False
    ),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        help="Ray cluster: HOST:PORT; auto: the one on this machine; local: start one for this batch.",
        metavar="ADDRESS",
        show_default="$RAY_ADDRESS, else auto",
    ),
]
NoCredentials = Annotated[
    bool,
    typer.Option(
        "--no-send-credentials", help="Do not send this environment's credentials for stores to the Ray nodes."
    ),
]
DepthModel = Annotated[
    str | None,
    typer.Option(
        help="Depth network to use, if it has moved since the window was recorded or should be another.",
        metavar="MODEL",
    ),
]
KeepGoing = Annotated[
    bool,
    typer.Option(
        "--keep-going",
        help="Write a row for each window that fails for a common cause, such as an unreachable store, instead of "
        "stopping early.",
    ),
]


def batch(
    windows: Windows,
    output: Annotated[Path, typer.Option(help="Folder for the tables (Parquet).", metavar="DIR", show_default=False)],
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="local: processes on this machine; ray: a Ray cluster.")
    ] = "local",
    ray_address: RayAddress = None,
    no_credentials: NoCredentials = False,
    with_config: Annotated[
        Path | None,
        typer.Option(
            "--with-config", help="Evaluate with this configuration instead of each window's own.", metavar="FILE"
        ),
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="Evaluate with this rig (JSON).", metavar="FILE")] = None,
    depth: DepthModel = None,
    jobs: Annotated[
        int | None, typer.Option(help="Number of windows at a time.", metavar="N", min=1, show_default="the cores")
    ] = (None),
    resume: Annotated[bool, typer.Option("--resume", help="Continue the batch that is in the folder.")] = False,
    keep_going: KeepGoing = False,
    deadline_s: Annotated[
        float, typer.Option("--deadline", help="Time limit for one window, s.", metavar="SECONDS", min=1.0)
    ] = 600.0,
    memory_mib: Annotated[
        int, typer.Option("--memory", help="Memory limit for one process, MiB.", metavar="MIB", min=256)
    ] = 2048,
    as_json: Json = False,
) -> int:
    """Evaluate many windows again: exit 0 if every one has a result, 1 if not."""
    from coec.fleet import batch as fleet_batch
    from coec.fleet.evaluator import load_settings
    from coec.fleet.jobs import jobs_of
    from coec.fleet.worker_pool import WorkerLimits

    terms = load_settings(with_config, rig, depth)
    inputs = jobs_of(windows)
    bounds = WorkerLimits(deadline_s, memory_mib * MIB)
    if keep_going:
        bounds = replace(bounds, alike=None)
    # Ray prints what happens to its nodes on standard output, which is for the report. Its log files have it, too.
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        workers = _engine(engine, jobs, bounds, ray_address, send_credentials=not no_credentials)
        try:
            with _progress(len(inputs)) as on_row:
                report = fleet_batch.run(inputs, terms, workers, output, on_row, resume=resume)
        finally:
            workers.close()
    console.report(report, lambda: _show(report, workers.cores), as_json=as_json)
    return 1 if report.errors else 0


def _engine(
    name: str, jobs: int | None, bounds: WorkerLimits, ray_address: str | None, *, send_credentials: bool
) -> Engine:
    if name == "ray":
        from coec.fleet.engines import RayEngine

        return RayEngine(jobs, bounds, ray_address, send_credentials=send_credentials)
    if ray_address is not None:
        raise UsageError("--ray-address is for --engine ray")
    from coec.fleet.engines import LocalEngine

    return LocalEngine(jobs or len(os.sched_getaffinity(0)), bounds)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[WindowRow], None]]:
    """A function to call with every row; it shows a bar with rate and remaining time, or prints a line now and then.
    It says why the first window of each kind of error has no result."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    bars = Progress(
        PlainColumn("windows"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        PlainColumn("{task.fields[note]}"),
        console=console.err,
        transient=True,
        disable=not console.err.is_terminal,
        speed_estimate_period=300.0,
    )
    task = bars.add_task("windows", total=total, note="")
    done, errors, began_s, printed_s = 0, 0, time.monotonic(), time.monotonic()
    seen: set[str] = set()

    def on_row(row: WindowRow) -> None:
        nonlocal done, errors, printed_s
        done, errors = done + 1, errors + (row.error is not None)
        if row.error_code is not None and row.error_code not in seen:
            seen.add(row.error_code)
            console.say(row.error if row.error and row.url in row.error else f"{row.url}: {row.error}")
        now_s = time.monotonic()
        note = f"{done / max(now_s - began_s, 1e-9):.2f}/s, {errors} without a result"
        bars.update(task, advance=1, note=note)
        if bars.disable and now_s - printed_s > LINE_S:
            printed_s = now_s
            console.say(f"{done} of {count(total, 'window')} evaluated, {note}")

    with bars:
        yield on_row


def _show(report: BatchReport, cores: int) -> None:
    rows = console.table("windows", "", right=(1,))
    rows.add_row("in all", str(report.windows))
    if report.kept:
        rows.add_row("evaluated before", str(report.kept))
    rows.add_row("accepted", str(report.accepted))
    rows.add_row("refused", str(report.refused))
    for code, number in report.errors.items():
        rows.add_row(f"without a result: {code}", str(number))
    rows.add_row("compared with the vehicle's decision", str(report.compared))
    rows.add_row("decided otherwise", str(report.differing))
    console.out.print(rows)
    if report.share_of_ideal is not None:
        share = f"{100.0 * report.share_of_ideal:.0f} % of what {count(cores, 'core')} can do"
        console.show(f"{report.elapsed_s:.1f} s, {report.cpu_s:.1f} s of processor time, {share}")
    console.show(f"tables in {report.output}")
