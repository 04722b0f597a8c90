"""`coec demo --rig`: a knocked LiDAR and a knocked camera, told apart, as pictures of the rig seen from above."""

from __future__ import annotations

from pathlib import Path

from coec.simulation.source import require_extra


def run(output: Path, *, as_json: bool) -> int:
    """Runs the demonstration; 1 if the story did not come true: the sensor that was knocked is not named, or another.

    Raises:
        SourceError: what casts the rays is not installed.
        OutputError: a file cannot be written.
    """
    require_extra()
    from coec.cli.demo.rig import performance

    return performance.run(output, as_json=as_json)
