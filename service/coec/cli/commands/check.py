"""What `coec check` takes."""

from __future__ import annotations

from dataclasses import dataclass

from coec.cli.options import Depth, Json, Source


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Source
    depth: Depth = None
    as_json: Json = False


def run(options: Options) -> int:
    """Show what a recording holds and what it is good for: exit 1 if it allows no calibration."""
    from coec.cli import check as work

    return work.run(options.source, depth=options.depth, as_json=options.as_json)
