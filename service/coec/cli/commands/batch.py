"""What `coec batch` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    windows: Annotated[
        list[str],
        typer.Argument(
            metavar="WINDOW...", help="Windows (.mcap), folders or patterns, as paths or URLs.", show_default=False
        ),
    ]
    output: Annotated[Path, typer.Option(help="Folder for the tables (Parquet).", metavar="DIR", show_default=False)]
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="local: processes on this machine; ray: a Ray cluster.")
    ] = "local"
    ray_address: Annotated[
        str | None,
        typer.Option(
            help="Ray cluster: HOST:PORT; auto: the one on this machine; local: start one for this batch.",
            metavar="ADDRESS",
            show_default="$RAY_ADDRESS, else auto",
        ),
    ] = None
    no_credentials: Annotated[
        bool,
        typer.Option(
            "--no-send-credentials", help="Do not send this environment's credentials for stores to the Ray nodes."
        ),
    ] = False
    with_config: Annotated[
        Path | None,
        typer.Option("--with-config", help="Judge by this configuration instead of each window's own.", metavar="FILE"),
    ] = None
    rig: Annotated[Path | None, typer.Option(help="Judge with this rig (JSON).", metavar="FILE")] = None
    depth: Annotated[
        str | None,
        typer.Option(
            help="Depth network to use, if it has moved since the window was recorded or should be another.",
            metavar="MODEL",
        ),
    ] = None
    jobs: Annotated[int | None, typer.Option(help="Number of windows at a time.", min=1, show_default="the cores")] = (
        None
    )
    resume: Annotated[bool, typer.Option("--resume", help="Continue the batch that is in the folder.")] = False
    keep_going: Annotated[
        bool,
        typer.Option(
            "--keep-going",
            help="Write a row for each window that fails for a common cause, such as an unreachable store, instead of "
            "stopping early.",
        ),
    ] = False
    deadline_s: Annotated[float, typer.Option("--deadline", help="Time limit for one window, s.", min=1.0)] = 600.0
    memory_mib: Annotated[int, typer.Option("--memory", help="Memory limit for one process, MiB.", min=256)] = 2048
    as_json: Json = False


def run(options: Options) -> int:
    """Judge many windows again: exit 0 if every one has a result, 1 if not."""
    from coec.cli import batch as work

    return work.run(options)
