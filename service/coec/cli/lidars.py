"""`coec lidars`: where one LiDAR of a vehicle sits relative to another, from what both see."""

from __future__ import annotations

import time

import numpy as np

from coec.adapters.registration.nearest import Trees
from coec.calibration.lidar_to_lidar.registration import register
from coec.calibration.lidar_to_lidar.types import LidarEdge
from coec.cli.commands.lidars import Options
from coec.geometry.se3 import difference
from coec.reports import console
from coec.reports.page.words import count
from coec.sources.lidars import LidarRecording, open_lidars

DEGREES = np.array([*np.rad2deg(np.ones(3)), *np.ones(3)])
"""From rad and m to degrees and m."""


def run(options: Options) -> int:
    """Prints the pose of `b` in `a`; returns 1 if they see too little in common.

    Raises:
        UsageError, SourceError: see `open_lidars`; or the library that searches clouds is not installed.
    """
    search = Trees()
    recording = open_lidars(options.source, options.a, options.b)
    started_s = time.monotonic()
    with console.progress() as bars:
        bars.add_task(recording.name, total=None, note="sweeps")
        pairs = recording.pairs(options.pairs)
        edge = register(recording.rig, pairs, search)
    error = None
    if recording.truth is not None:
        error = DEGREES * difference(edge.T_a_b, recording.truth(pairs[len(pairs) // 2].a.stamp_ns))
    if options.as_json:
        console.print_json(_document(edge, error, time.monotonic() - started_s))
    else:
        _show(recording, edge, error)
    return 0 if not edge.reasons else 1


def _show(recording: LidarRecording, edge: LidarEdge, error: np.ndarray | None) -> None:
    told = console.table("axis of " + edge.rig.a, "correction", "sigma", *(["error"] if error is not None else []))
    rows = zip(console.AXES, console.UNITS, DEGREES * edge.correction, DEGREES * edge.sigma, strict=True)
    for number, (axis, unit, correction, sigma) in enumerate(rows):
        off = [] if error is None else [f"{error[number]:+.3f} {unit}"]
        told.add_row(axis, f"{correction:+.3f} {unit}", f"{sigma:.3f} {unit}", *off)
    console.out.print(told)
    bias = edge.range_bias
    console.show(
        f"{recording.name}: {edge.rig.b} in {edge.rig.a}, {count(edge.pairs, 'pair')} of sweeps, {edge.points} points "
        f"of {edge.rig.b} on surfaces of {edge.rig.a} ({100 * edge.share:.0f} %), {1000 * edge.rms_m:.0f} mm from them"
        f"; {edge.rig.b} measures {1000 * bias.longer_m:+.0f} ± {1000 * bias.sigma_m:.0f} mm longer"
    )
    for reason in edge.reasons:
        console.show(reason.text, "bold red")


def _document(edge: LidarEdge, error: np.ndarray | None, elapsed_s: float) -> dict[str, object]:
    return {
        "a": edge.rig.a,
        "b": edge.rig.b,
        "T_a_b": edge.T_a_b.tolist(),
        "correction": (DEGREES * edge.correction).tolist(),
        "sigma": (DEGREES * edge.sigma).tolist(),
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
