"""`coec fleet`: its commands."""

from __future__ import annotations

import typer

from coec.cli.commands import fleet_report
from coec.cli.declaring import taking

app = typer.Typer(no_args_is_help=True, help="What the windows of many vehicles say together (optional extra `fleet`).")
app.command("report")(taking(fleet_report.run))


@app.callback()
def _fleet() -> None:
    # Without a callback, Typer takes a group of one command for that command.
    pass
