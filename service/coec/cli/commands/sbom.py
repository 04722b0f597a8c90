"""What `coec sbom` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    lock: Annotated[
        Path | None,
        typer.Option(help="requirements.lock of the installation, for hashes.", metavar="FILE"),
    ] = None
    output: Annotated[Path | None, typer.Option(help="Write coec.cdx.json and licences.md.", metavar="DIR")] = None
    as_json: Json = False


def run(options: Options) -> int:
    """List the packages of this installation: a table of licences, with --json a bill of materials (CycloneDX)."""
    from coec.cli import sbom as work

    return work.run(options.lock, options.output, as_json=options.as_json)
