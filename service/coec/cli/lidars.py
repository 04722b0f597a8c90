"""`coec lidars`: estimates the pose of one LiDAR of a vehicle relative to another, from surfaces that both see."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Json
from coec.reports import console
from coec.reports.formatting import count

if TYPE_CHECKING:
    import numpy as np

    from coec.calibration.rig.lidar_sampling import LidarEdge
    from coec.io.recordings.layouts import LidarRecording


def lidars(
    source: Annotated[
        str,
        typer.Argument(help="A ROS 2 bag, or sim:rig=four-fisheyes&seconds=60.", metavar="SOURCE", show_default=False),
    ],
    a: Annotated[
        str,
        typer.Argument(
            help="Topic of the denser LiDAR; for a simulated rig, its name.", metavar="A", show_default=False
        ),
    ],
    b: Annotated[
        str, typer.Argument(help="The same of the LiDAR whose pose in A is estimated.", metavar="B", show_default=False)
    ],
    pairs: Annotated[
        int, typer.Option(help="Number of pairs of sweeps, spread evenly over the recording.", min=1, max=200)
    ] = 12,
    as_json: Json = False,
) -> int:
    """Find the pose of one LiDAR in another from the surfaces that both see: exit 1 if those are too few."""
    from coec.calibration.rig.lidar_registration import register
    from coec.calibration.rig.nearest_neighbours import require_installed
    from coec.geometry.se3 import difference
    from coec.io.recordings.layouts import open_lidars
    from coec.io.serialise import in_degrees

    require_installed()
    recording = open_lidars(source, a, b)
    started_s = time.monotonic()
    with console.progress() as bars:
        bars.add_task(recording.name, total=None, note="sweeps")
        sweeps = recording.pairs(pairs)
        edge = register(recording.rig, sweeps)
    error = None
    if recording.truth is not None:
        error = in_degrees(difference(edge.T_a_b, recording.truth(sweeps[len(sweeps) // 2].a.stamp_ns)))
    console.report(
        _document(edge, error, time.monotonic() - started_s), lambda: _show(recording, edge, error), as_json=as_json
    )
    return 0 if not edge.reasons else 1


def _show(recording: LidarRecording, edge: LidarEdge, error: np.ndarray | None) -> None:
    from coec.io.serialise import in_degrees

    table = console.table("axis of " + edge.rig.a, "correction", "sigma", *(["error"] if error is not None else []))
    rows = zip(console.AXES, console.UNITS, in_degrees(edge.correction), in_degrees(edge.sigma), strict=True)
    for number, (axis, unit, correction, sigma) in enumerate(rows):
        off = [] if error is None else [f"{error[number]:+.3f} {unit}"]
        table.add_row(axis, f"{correction:+.3f} {unit}", f"{sigma:.3f} {unit}", *off)
    console.out.print(table)
    bias = edge.range_bias
    console.show(
        f"{recording.name}: {edge.rig.b} in {edge.rig.a}, {count(edge.pairs, 'pair')} of sweeps, {edge.points} points "
        f"of {edge.rig.b} on surfaces of {edge.rig.a} ({100 * edge.share:.0f} %), {1000 * edge.rms_m:.0f} mm from them"
        f"; {edge.rig.b} measures {1000 * bias.longer_m:+.0f} ± {1000 * bias.sigma_m:.0f} mm longer"
    )
    for reason in edge.reasons:
        console.show(reason.text, "bold red")


def _document(edge: LidarEdge, error: np.ndarray | None, elapsed_s: float) -> dict[str, object]:
    from coec.io.serialise import in_degrees

    return {
        "a": edge.rig.a,
        "b": edge.rig.b,
        "T_a_b": edge.T_a_b.tolist(),
        "correction": in_degrees(edge.correction).tolist(),
        "sigma": in_degrees(edge.sigma).tolist(),
        "covariance": edge.covariance.tolist(),
        "error": None if error is None else error.tolist(),
        "range_bias_m": edge.range_bias.longer_m,
        "range_bias_sigma_m": edge.range_bias.sigma_m,
        "rms_m": edge.rms_m,
        "points": edge.points,
        "share": edge.share,
        "pairs": edge.pairs,
        "reasons": [{"code": reason.code, "text": reason.text} for reason in edge.reasons],
        "elapsed_s": elapsed_s,
    }
