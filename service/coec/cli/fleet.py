"""`coec fleet`: combines the results and baselines of many vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.commission import document_of, show_learned
from coec.cli.options import Json
from coec.errors import DecodeError, UsageError
from coec.reports import console
from coec.reports.console import figure
from coec.reports.formatting import count

if TYPE_CHECKING:
    from coec.calibration.baseline import Baseline
    from coec.schemas.documents import FleetNow, FleetReport

app = typer.Typer(no_args_is_help=True, help="Combine results of many vehicles.")

SHOWN = 15
"""Most pairs in the table on the screen; the page has all."""


@app.command()
def report(
    results: Annotated[
        Path, typer.Argument(metavar="RESULTS", help="Output folder of `coec batch`.", show_default=False)
    ],
    output: Annotated[Path | None, typer.Option(help="Write report.html and report.json.", metavar="DIR")] = None,
    against: Annotated[
        Path | None, typer.Option(help="Results of an earlier batch over the same windows.", metavar="RESULTS")
    ] = None,
    now: Annotated[
        Path | None,
        typer.Option(help="Output of `coec watch --once --json`: also count false alarms.", metavar="FILE"),
    ] = None,
    sql: Annotated[bool, typer.Option("--sql", help="Print only the columns and useful queries.")] = False,
    as_json: Json = False,
) -> int:
    """Report drift of every pair, what is refused and why, and what an earlier batch decided otherwise."""
    from coec.fleet import report as fleet_report
    from coec.io import user_files as files
    from coec.reports import fleet_page, page
    from coec.reports.page_parts import Provenance
    from coec.schemas.message import to_json

    if sql:
        _show_sql(results)
        return 0
    fleet_now = None if now is None else _fleet_now(now)
    summary = fleet_report.report(results, against, fleet_now)
    if output is not None:
        of_fleet = fleet_page.page(summary, f"Fleet: {results.resolve().name}", Provenance.here())
        page.write(output / "report.html", of_fleet)
        files.write_output(output / "report.json", to_json(summary))
    if as_json:
        console.print_json(summary)
        return 0
    _show(summary)
    if output is not None:
        console.show(f"{output / 'report.html'}")
    return 0


def _show(summary: FleetReport) -> None:
    from coec.reports import fleet_page
    from coec.schemas.documents import AXES

    console.show(fleet_page.sentence(summary))
    table = console.table(
        "vehicle", "pair", "windows", "accepted", "worst axis", "drift", "urgency", right=(2, 3, 5, 6)
    )
    for pair in summary.pairs[:SHOWN]:
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
    if len(summary.pairs) > SHOWN:
        console.show(f"and {len(summary.pairs) - SHOWN} more")
    if summary.changes is not None:
        changes = summary.changes
        console.show(
            f"against the earlier batch: {count(changes.both, 'window')} in both, {changes.identical} identical, "
            f"{changes.newly_accepted} newly accepted, {changes.newly_refused} newly refused, "
            f"{changes.newly_failing} without a result any more"
        )
    if summary.false_alarms is not None:
        console.show(fleet_page.sentence_of_alarms(summary.false_alarms))


def _fleet_now(path: Path) -> FleetNow:
    from coec.schemas.documents import FleetNow
    from coec.schemas.message import from_json

    try:
        return from_json(FleetNow, path.read_bytes())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from error
    except DecodeError as error:
        raise UsageError(f"{path} is not what `coec watch --once --json` prints: {error}") from error


def _show_sql(results: Path) -> None:
    from coec.fleet.report import EXAMPLE_QUERIES, WINDOWS_VIEW, columns, view_statement

    console.write(f"-- the view `{WINDOWS_VIEW}` of the examples below\n")
    console.write(f"{view_statement(WINDOWS_VIEW, results)};\n\n")
    for name, kind in columns(results):
        console.write(f"--   {name:<22} {kind}\n")
    for question, query in EXAMPLE_QUERIES.items():
        console.write(f"\n-- {question}{query};\n")


@app.command()
def commission(
    baselines: Annotated[
        list[Path],
        typer.Argument(
            metavar="RIG...", help="rig.json files of commissioned vehicles of one model.", show_default=False
        ),
    ],
    output: Annotated[Path, typer.Option(help="File to write: the baselines of the model.", metavar="FILE")] = Path(
        "model.json"
    ),
    as_json: Json = False,
) -> int:
    """Learn from commissioned vehicles what others of their model start from (`state.model`): bias, spread, limits."""
    from coec.calibration.baseline import model_baseline
    from coec.io.rig_files import load_baselines, save_baseline

    vehicles = [load_baselines(path) for path in _each_once(baselines)]
    for path, pairs in zip(baselines, vehicles, strict=True):
        if not pairs:
            raise UsageError(f"{path} holds no baseline: `coec commission`, or the command `commission`, makes them")
    shared = sorted(set.intersection(*(set(pairs) for pairs in vehicles)))
    if not shared:
        raise UsageError("no pair is common to all vehicles")
    models = [model_baseline([pairs[name] for pairs in vehicles]) for name in shared]
    for model in models:
        save_baseline(output, model)
    if as_json:
        console.print_json({"vehicles": len(vehicles), "pairs": [document_of(model) for model in models]})
        return 0
    for model in models:
        _show_model(model, len(vehicles))
    console.show(f"written to {output}: name it as `state.model` on vehicles that are not commissioned")
    return 0


def _each_once(paths: Sequence[Path]) -> Sequence[Path]:
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise UsageError(f"named twice: {', '.join(twice)}; each vehicle counts once")
    return paths


def _show_model(model: Baseline, vehicles: int) -> None:
    console.show(
        f"{model.pair}: {count(vehicles, 'vehicle')}, {count(model.pairs, 'pair')} of {count(model.windows, 'window')}"
    )
    show_learned(model)
