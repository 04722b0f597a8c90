"""The published figures of Borer, Tschirner, Ölsner and Milz, CVPR-W 2023, to compare ours with: KITTI-360 drive 0000,
raw fisheye, MiDaS `dpt_beit_large_512`; run times on a 12-core Jetson Orin."""

from __future__ import annotations

FLAGGED = {1.0: 0.998, 3.0: 1.0}
"""Share of wrong extrinsics that equation (2) flags, by the degrees they are off; 50 frames."""

FAR_RUNS, FAR_HITS = 100, 36
"""Runs from 25° away with 25 frames, and how many end within 0.5°; all runs are classified correctly."""

ERRORS_DEG = {
    5.0: ((0.129, 0.117), (-0.010, 0.151), (-0.118, 0.175)),
    10.0: ((0.130, 0.117), (-0.011, 0.151), (-0.121, 0.171)),
}
"""Mean and standard deviation of pitch, yaw and roll over 1400 runs, by the radius of the starts (its table 1)."""

RUN_TIMES_MS = {5: (4.2, 808.0), 25: (21.5, 4222.0), 50: (42.8, 7916.0)}
"""One averaged MI, and the whole optimisation, by the number of frames (its table 2)."""


def document() -> dict[str, object]:
    """All of them, for reports."""
    return {
        "flagged": {f"{moved:g}": share for moved, share in FLAGGED.items()},
        "far": {"runs": FAR_RUNS, "hits": FAR_HITS},
        "errors_deg": {f"{radius:g}": axes for radius, axes in ERRORS_DEG.items()},
        "run_times_ms": {str(frames): times for frames, times in RUN_TIMES_MS.items()},
    }
