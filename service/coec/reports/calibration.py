"""What `coec calibrate` prints for people: the result in a form to copy, and what it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from coec.adapters.depth.maps import STEREO
from coec.calibration.types import Compensation, Window
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.edges.scan_lines import distinct_rings
from coec.reports import console
from coec.reports.page.words import count
from coec.schemas.replies import CalibrationResult, Transform, Vector6

DIGITS = 9
"""Decimal places of a matrix and a quaternion to copy: a rotation is then exact to 1e-9 rad, far below any σ. `--json`
and `result.json` have all digits."""

HASH_DIGITS = 12
"""Digits of a network's hash, as in `coec models`."""

NOT_COMPENSATED: Mapping[Compensation, str] = {
    Compensation.NO_EGO_MOTION: "no ego motion in the source",
    Compensation.NO_POINT_TIME: "the points carry no time, and the LiDAR's sweep is not described",
    Compensation.DISABLED: "switched off",
}


def show(
    window: Window,
    result: CalibrationResult,
    *,
    configuration: CalibrationConfig,
    camera_fit: Mapping[str, Any] | None,
    time_offset: Mapping[str, Any] | None,
    elapsed_s: Mapping[str, float],
) -> None:
    """Prints the result of a window.

    Args:
        window, result: what was calibrated, and the result.
        configuration: with which it was calibrated.
        camera_fit, time_offset: as `--json` has them; None: not asked for.
        elapsed_s: seconds by stage.
    """
    console.show(f"{window.window_id}: {count(result.pairs, 'pair')}, {result.points_in_view} points in view")
    _show_axes(window, result)
    console.show_verdict(result)
    if result.verdict.decision != "accepted":
        console.show("what follows was not accepted: it is the best guess, and not to be used on a vehicle", "yellow")
    show_pose(result.camera_from_lidar, result.lidar_frame, result.camera_frame)
    console.show(settings_text(configuration, result.depth_identity))
    console.show(compensation_text(result.compensation))
    if any(pair.lidar.ring is not None and distinct_rings(pair.lidar.ring) is None for pair in window.pairs):
        console.show(
            "the field `ring` holds one number and was ignored: beams were told apart by their elevation", "yellow"
        )
    for note in remarks(camera_fit, time_offset):
        console.show(note)
    if result.independent_looks is not None:
        console.show(
            f"{result.pairs} pairs are worth {result.independent_looks:.1f} independent looks{_together(result)}"
        )
    stages = "  ".join(f"{stage} {seconds:.2f} s" for stage, seconds in elapsed_s.items())
    console.show(f"{result.evaluations} evaluations, {result.stop_reason}; {stages}")


def remarks(camera_fit: Mapping[str, Any] | None, time_offset: Mapping[str, Any] | None) -> list[str]:
    """What else was found out, one sentence each; both arguments as `--json` has them, None: not asked for."""
    sentences = []
    if camera_fit is not None:
        sentences.append(
            f"{camera_fit['model']} fitted to {camera_fit['of']}: {camera_fit['residual_rms_px']:.4f} px rms, "
            f"{camera_fit['residual_max_px']:.4f} px at most"
        )
    if time_offset is not None:
        sentences.append(f"camera after its stamp: {_offset_text(time_offset)}")
    return sentences


def start_of(window: Window) -> Vector6:
    """Start of a window's search, relative to the recording's own calibration: rx ry rz (deg), tx ty tz (m)."""
    start = se3.difference(window.T_camera_lidar_start, window.rig.T_camera_lidar_nominal)
    start[:3] = np.degrees(start[:3])
    return cast("Vector6", tuple(float(value) for value in start))


def show_pose(camera_from_lidar: Transform, lidar_frame: str, camera_frame: str) -> None:
    """Prints the pose in a form to copy: a matrix that Python, YAML and JSON read as it stands."""
    console.show(f"T_camera_lidar: p_camera = T · p_lidar, from frame {lidar_frame} to frame {camera_frame}, metres:")
    rows = [f"[{', '.join(f'{value + 0.0:.{DIGITS}f}' for value in row)}]" for row in camera_from_lidar.matrix]
    for before, row, after in zip(("[", " ", " ", " "), rows, (",", ",", ",", "]"), strict=True):
        console.show(f"  {before}{row}{after}")
    console.show(f"translation x y z, m: {_numbers(camera_from_lidar.translation_m)}")
    console.show(f"quaternion x y z w: {_numbers(camera_from_lidar.quaternion_xyzw)}")


def show_written(folder: Path, written: Sequence[Path], left_out: Sequence[str] = ()) -> None:
    """Prints which files a command wrote and where, and what it left out, one sentence each."""
    console.show(f"written to {folder}: {', '.join(sorted(str(path.relative_to(folder)) for path in written))}")
    for sentence in left_out:
        console.show(sentence)


def settings_text(configuration: CalibrationConfig, depth_identity: str) -> str:
    """What was maximised over which axes, and where depth came from."""
    searched = "6 degrees of freedom" if configuration.search.dof == 6 else "3 degrees of freedom (rotation only)"
    model = configuration.depth.model
    # Maps that came with the frames have no hash.
    network = model if model == STEREO else f"{Path(model).name} (sha256 {depth_identity[:HASH_DIGITS]})"
    return f"objective {configuration.objective.kind}, {searched}, depth from {network}"


def compensation_text(pairs_by_outcome: Mapping[str, int]) -> str:
    """What became of motion compensation, from the number of pairs of each outcome (`Compensation`)."""
    total = sum(pairs_by_outcome.values())
    compensated = pairs_by_outcome.get(Compensation.DONE, 0)
    turned = pairs_by_outcome.get(Compensation.ROTATION_ONLY, 0)
    why = [
        (f"{some} of {total} pairs: " if some < total else "") + reason
        for outcome, reason in NOT_COMPENSATED.items()
        if (some := pairs_by_outcome.get(outcome, 0))
    ]
    if not why:
        return "motion-compensated" + (", turns only: the source tells no speed" if turned and not compensated else "")
    return f"not motion-compensated: {'; '.join(why)}"


def _show_axes(window: Window, result: CalibrationResult) -> None:
    start = start_of(window)
    axes = console.table("axis", "start", "correction", "± σ", "unit", right=(1, 2, 3))
    for axis, name in enumerate(console.AXIS_NAMES):
        unsolved = "not observable" if result.unobservable[axis] else "not searched"
        correction = console.figure(result.correction[axis], sign=True) if result.solved[axis] else unsolved
        spread = console.figure(result.sigma[axis]) if result.solved[axis] else ""
        axes.add_row(name, console.figure(start[axis], sign=True), correction, spread, console.UNITS[axis])
    console.out.print(axes)


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value + 0.0:.{DIGITS}f}' for value in values)}]"


def _together(result: CalibrationResult) -> str:
    """How the errors of turns and shifts correlate, where both were solved."""
    pairs = {"pitch and height": result.correlation_pitch_height, "yaw and side": result.correlation_yaw_side}
    correlations = ", ".join(f"{names} {value:+.2f}" for names, value in pairs.items() if value is not None)
    return f"; correlation of errors: {correlations}" if correlations else ""


def _offset_text(offset: Mapping[str, Any]) -> str:
    if not offset["observable"]:
        return f"not observable, {offset['reason']}"
    return f"{1e3 * offset['offset_s']:+.1f} ± {1e3 * offset['sigma_s']:.1f} ms, {offset['reason']}"
