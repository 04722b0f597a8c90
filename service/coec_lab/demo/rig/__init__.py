"""`coec demo --rig`: tells a knocked LiDAR from a knocked camera, and shows the rig from above."""

from __future__ import annotations

from pathlib import Path

from coec.simulation.source import require_extra


def run(output: Path, *, as_json: bool) -> int:
    """Runs the demonstration; returns 1 if the knocked sensor was not named, or another one was.

    Raises:
        SourceError: the library that casts rays is not installed.
        OutputError: a file cannot be written.
    """
    require_extra()
    from coec_lab.demo.rig import performance

    return performance.run(output, as_json=as_json)
