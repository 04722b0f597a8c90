"""What `coec fleet report` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    results: Annotated[
        Path, typer.Argument(metavar="RESULTS", help="Output folder of `coec batch`.", show_default=False)
    ]
    output: Annotated[Path | None, typer.Option(help="Write report.html and report.json.", metavar="DIR")] = None
    against: Annotated[
        Path | None, typer.Option(help="Results of an earlier batch over the same windows.", metavar="RESULTS")
    ] = None
    now: Annotated[
        Path | None,
        typer.Option(help="Output of `coec watch --once --json`: also count false alarms.", metavar="FILE"),
    ] = None
    sql: Annotated[bool, typer.Option("--sql", help="Print only the columns and useful queries.")] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Report drift of every pair, what is refused and why, and what an earlier batch decided otherwise."""
    from coec.cli import fleet as work

    return work.run(options)
