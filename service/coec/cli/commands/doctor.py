"""What `coec doctor` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of the daemon (YAML).", metavar="FILE", show_default="/etc/coec/coec.yaml"),
    ] = None
    seconds: Annotated[float, typer.Option(help="How long to listen to the streams.", min=0.5, max=600)] = 5.0
    as_json: Json = False


def run(options: Options) -> int:
    """Find what keeps this computer from a calibration: exit 1 if something must be done first.

    Looks at the configuration, disk, clock, certificates, router and its rules, streams, and the running service if
    there is one; changes and disturbs nothing.
    """
    from coec.cli import doctor as work

    return work.run(options)
