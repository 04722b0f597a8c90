"""`coec fleet report`: what many windows say about a fleet."""

from __future__ import annotations

from pathlib import Path

from coec.adapters.files import output
from coec.cli.commands.fleet_report import Options
from coec.errors import DecodeError, UsageError
from coec.fleet import questions, report
from coec.reports import console, fleet_page, page, provenance
from coec.reports.console import figure
from coec.reports.page.words import count
from coec.schemas.base import from_json, to_json
from coec.schemas.fleet import AXES, FleetReport
from coec.schemas.fleet_now import FleetNow

SHOWN = 15
"""Most pairs in the table on the screen; the page has all."""


def run(options: Options) -> int:
    """Writes page and document into the output folder, if one is given, and prints the most urgent pairs.

    Raises:
        UsageError: there are no tables, or the file of `--now` is no such document.
        SourceError: the optional extra is not installed.
        OutputError: a file cannot be written.
    """
    if options.sql:
        _show_sql(options.results)
        return 0
    now = None if options.now is None else _said(options.now)
    told = report.report(options.results, options.against, now)
    if options.output is not None:
        of_fleet = fleet_page.page(told, f"Fleet: {options.results.resolve().name}", provenance.here())
        page.write(options.output / "report.html", of_fleet)
        output.write(options.output / "report.json", to_json(told))
    if options.as_json:
        console.print_json(told.model_dump(mode="json"))
        return 0
    _show(told)
    if options.output is not None:
        console.show(f"{options.output / 'report.html'}")
    return 0


def _show(told: FleetReport) -> None:
    console.show(fleet_page.sentence(told))
    table = console.table(
        "vehicle", "pair", "windows", "accepted", "worst axis", "drift", "urgency", right=(2, 3, 5, 6)
    )
    for pair in told.pairs[:SHOWN]:
        axis = None if pair.worst is None else AXES.index(pair.worst)
        table.add_row(
            pair.vehicle,
            pair.pair,
            str(pair.windows),
            str(pair.accepted),
            "-" if pair.worst is None else pair.worst,
            "-" if axis is None else figure(pair.drift[axis], sign=True),
            f"{pair.urgency:.1f}",
        )
    console.out.print(table)
    if len(told.pairs) > SHOWN:
        console.show(f"and {len(told.pairs) - SHOWN} more")
    if told.changes is not None:
        changes = told.changes
        console.show(
            f"against the earlier batch: {count(changes.both, 'window')} in both, {changes.identical} identical, "
            f"{changes.newly_accepted} newly accepted, {changes.newly_refused} newly refused, "
            f"{changes.newly_failing} without a result any more"
        )
    if told.false_alarms is not None:
        console.show(fleet_page.sentence_of_alarms(told.false_alarms))


def _said(path: Path) -> FleetNow:
    try:
        return from_json(FleetNow, path.read_bytes())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from error
    except DecodeError as error:
        raise UsageError(f"{path} is not what `coec watch --once --json` prints: {error}") from error


def _show_sql(results: Path) -> None:
    console.write(f"-- the view `{questions.WINDOWS}` of the examples below\n")
    console.write(f"{questions.statement(questions.WINDOWS, results)};\n\n")
    for name, kind in questions.columns(results):
        console.write(f"--   {name:<22} {kind}\n")
    for question, query in questions.EXAMPLES.items():
        console.write(f"\n-- {question}{query};\n")
