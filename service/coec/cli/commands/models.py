"""`coec models`: what it takes, and its commands."""

from __future__ import annotations

import typer

from coec.cli.commands import models_add, models_show
from coec.cli.declaring import taking
from coec.cli.options import Json

app = typer.Typer(
    help="Depth networks: list the known ones and whose file is present, add a file, show its card, assess it."
)


@app.callback(invoke_without_command=True)
def _models(context: typer.Context, as_json: Json = False) -> None:
    if context.invoked_subcommand is None:
        from coec.cli import models as work

        raise typer.Exit(work.run(as_json=as_json))


app.command("show")(taking(models_show.run))
app.command("add")(taking(models_add.run))
