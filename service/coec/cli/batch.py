"""`coec batch`: judges many windows again and writes tables."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from coec.cli.commands.batch import Options
from coec.errors import UsageError
from coec.fleet import batch
from coec.fleet.engines.engine import Bounds, Engine
from coec.fleet.places import jobs_of
from coec.fleet.terms import terms_of
from coec.reports import console
from coec.reports.page.words import count
from coec.reports.progress import PlainColumn
from coec.schemas.fleet import BatchReport, WindowRow

MIB = 2**20

LINE_S = 30.0
"""Time between two lines of progress where standard error is no terminal."""


def run(options: Options) -> int:
    """Judges every window that has no row yet; returns 1 if one of them has no result.

    Raises:
        UsageError: no window, the folder holds another batch, or options do not belong together.
        ConfigError: the configuration cannot be used.
        SourceError: a store cannot be read, or an optional extra is not installed.
        OutputError: the folder cannot be written.
        FleetError: the engine failed, or windows could not be judged for a common cause.
    """
    terms = terms_of(options.with_config, options.rig, options.depth)
    jobs = jobs_of(options.windows)
    # Ray prints what happens to its nodes on standard output, which is for the report. Its log files have it, too.
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        engine = _engine(options)
        try:
            with _progress(len(jobs)) as told:
                report = batch.run(jobs, terms, engine, options.output, told, resume=options.resume)
        finally:
            engine.close()
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        _show(report, engine.cores)
    return 1 if report.errors else 0


def _engine(options: Options) -> Engine:
    bounds = Bounds(options.deadline_s, options.memory_mib * MIB)
    if options.keep_going:
        bounds = replace(bounds, alike=None)
    if options.engine == "ray":
        from coec.fleet.engines.ray import RayEngine

        return RayEngine(options.jobs, bounds, options.ray_address, send_credentials=not options.no_credentials)
    if options.ray_address is not None:
        raise UsageError("--ray-address is for --engine ray")
    from coec.fleet.engines.local import LocalEngine

    return LocalEngine(options.jobs or len(os.sched_getaffinity(0)), bounds)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[WindowRow], None]]:
    """A function to call with every row; it shows a bar with rate and remaining time, or prints a line now and then."""
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
    done, errors, began_s, said_s = 0, 0, time.monotonic(), time.monotonic()

    def told(row: WindowRow) -> None:
        nonlocal done, errors, said_s
        done, errors = done + 1, errors + (row.error is not None)
        now_s = time.monotonic()
        note = f"{done / max(now_s - began_s, 1e-9):.2f}/s, {errors} without a result"
        bars.update(task, advance=1, note=note)
        if bars.disable and now_s - said_s > LINE_S:
            said_s = now_s
            console.say(f"{done} of {count(total, 'window')} judged, {note}")

    with bars:
        yield told


def _show(report: BatchReport, cores: int) -> None:
    rows = console.table("windows", "", right=(1,))
    rows.add_row("in all", str(report.windows))
    if report.kept:
        rows.add_row("judged before", str(report.kept))
    rows.add_row("accepted", str(report.accepted))
    rows.add_row("refused", str(report.refused))
    for code, number in report.errors.items():
        rows.add_row(f"without a result: {code}", str(number))
    rows.add_row("compared with the vehicle's decision", str(report.compared))
    rows.add_row("decided otherwise", str(report.differing))
    console.out.print(rows)
    if report.share_of_ideal is not None:
        share = f"{100.0 * report.share_of_ideal:.0f} % of what {count(cores, 'core')} can do"
        console.show(f"{report.elapsed_s:.1f} s, {report.cpu_s:.1f} s of processor, {share}")
    console.show(f"tables in {report.output}")
