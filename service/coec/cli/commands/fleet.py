"""`coec fleet`: its commands."""

from __future__ import annotations

import typer

from coec.cli.commands import fleet_commission, fleet_report
from coec.cli.declaring import taking

app = typer.Typer(no_args_is_help=True, help="Combine results of many vehicles.")
app.command("report")(taking(fleet_report.run))
app.command("commission")(taking(fleet_commission.run))
