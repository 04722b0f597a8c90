"""`coec demo`: a simulated vehicle is displaced, and the running service detects it."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


def demo(
    output: Annotated[Path, typer.Option(help="Folder for pictures, window and result.", metavar="DIR")] = Path(
        "coec-demo"
    ),
    rig: Annotated[
        bool,
        typer.Option(
            "--rig",
            help="Show a vehicle with four cameras instead: a running service distinguishes a displaced LiDAR from a "
            "displaced camera. Pictures have 700 pixels a side.",
        ),
    ] = False,
    as_json: Json = False,
) -> int:
    """Displace the mount of a simulated vehicle and show the service detect and correct it: no data, two minutes."""
    if rig:
        from coec_lab.simulation.source import require_embree

        require_embree()
        from coec_lab.demo import rig as rig_demo

        return rig_demo.run(output, as_json=as_json)
    from coec_lab.demo import pair

    return pair.run(output, as_json=as_json)
