"""`coec sim`: its commands."""

from __future__ import annotations

import typer

from coec.cli.commands import sim_checks, sim_drive, sim_matrix, sim_rig_drives, sim_rig_moves, sim_view
from coec.cli.declaring import taking

app = typer.Typer(no_args_is_help=True, help="Simulate a vehicle (optional extra `sim`).")
app.command("drive")(taking(sim_drive.run))
app.command("view")(taking(sim_view.run))
app.command("matrix")(taking(sim_matrix.run))
app.command("checks")(taking(sim_checks.run))
app.command("rig-moves")(taking(sim_rig_moves.run))
app.command("rig-drives")(taking(sim_rig_drives.run))
