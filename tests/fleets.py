"""Fleets that do not exist: rows of windows as a batch leaves them, drawn with a seed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from coec.fleet.places import Job
from coec.fleet.trouble import empty_row, lost_row
from coec.schemas.fleet import WindowRow
from coec.schemas.replies import CalibrationResult, Reason, Verdict

BEGIN_NS = 1_700_000_000_000_000_000
HOUR_NS = 3_600_000_000_000

WINDOW_SIGMA = np.array([0.03, 0.02, 0.03, 0.01, 0.01, 0.01])
"""deg and m, of a window."""

REFUSED_SHARE, FAILED_SHARE = 0.05, 0.01
"""Shares."""


def fleet_rows(
    pattern: CalibrationResult, vehicles: int, windows: int, drifts: dict[int, tuple[int, float]], seed: int
) -> Iterator[WindowRow]:
    """The rows of a fleet, vehicle by vehicle, a window every 2.4 hours.

    Args:
        pattern: a real result, for whatever is not drawn.
        vehicles: their number; they are called v000 and so on.
        windows: of each.
        drifts: by the index of a vehicle, an axis and by how much it turns or moves from first to last window.
        seed: of everything.
    """
    rng = np.random.default_rng(seed)
    for vehicle in range(vehicles):
        name = f"v{vehicle:03}"
        mount = rng.normal(0.0, 0.3, 6) * (WINDOW_SIGMA / WINDOW_SIGMA[0])
        axis, drift = drifts.get(vehicle, (0, 0.0))
        for window in range(windows):
            stamp_ns = BEGIN_NS + round(2.4 * HOUR_NS) * window
            url = f"{name}/front-{stamp_ns}.mcap"
            sha256 = hashlib.sha256(url.encode()).hexdigest()
            chance = rng.random()
            if chance < FAILED_SHARE:
                yield lost_row(Job(url), "bad_window", "it is cut off").model_copy(update={"sha256": sha256})
                continue
            correction = mount + rng.normal(0.0, WINDOW_SIGMA)
            correction[axis] += drift * window / max(windows - 1, 1)
            refused = chance < FAILED_SHARE + REFUSED_SHARE
            result = pattern.model_copy(
                update={
                    "vehicle": name,
                    "pair": "front",
                    "window_id": f"front-{stamp_ns}",
                    "data_stamp_ns": stamp_ns,
                    "correction": tuple(float(value) for value in correction),
                    "solved": (True,) * 6,
                    "unobservable": (False,) * 6,
                    "verdict": Verdict(
                        decision="failed" if refused else "accepted",
                        reasons=(Reason(code="sigma_deg", text="too wide"),) if refused else (),
                    ),
                }
            )
            yield empty_row(Job(url), {"coec": "0.1.0"}).model_copy(
                update={"sha256": sha256, "vehicle": name, "result": result, "decided": sha256, "seconds": 1.0}
            )
