"""What `coec bench` takes."""

from __future__ import annotations

from dataclasses import dataclass

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    as_json: Json = False


def run(options: Options) -> int:
    """Measure the speed of the kernels and of a solve on this machine, beside plain implementations in the same run."""
    from coec_lab import bench as work

    return work.run(as_json=options.as_json)
