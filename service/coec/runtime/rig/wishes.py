"""Says of which pairs a window is wanted soon. When a sensor was named, one correction for all its pairs waits for a
window of each. A pair that suspects nothing itself would end its window minutes later, with its ordinary slice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from coec.calibration.rig.vehicle import VehicleRig, pairs_of


@dataclass(frozen=True, slots=True)
class WindowRequest:
    """A window of a pair is wanted.

    Attributes:
        since_ns: only frames since this sensor time are wanted; earlier ones show the mount before the move.
        from_ns: sensor time from which the wish counts.
    """

    since_ns: int
    from_ns: int


def window_requests(before: VehicleRig | None, rig: VehicleRig | None, from_ns: int) -> Mapping[str, WindowRequest]:
    """The new wishes, by pair: those that hold for `rig` and did not for `before`. They count from `from_ns` on."""
    if rig is None or rig.event is None:
        return {}
    known = _pairs_without_window(before)
    return {
        name: WindowRequest(rig.event.stepped_ns, from_ns) for name in _pairs_without_window(rig) if name not in known
    }


def _pairs_without_window(rig: VehicleRig | None) -> tuple[str, ...]:
    """Pairs of the moved sensors without a window since the move, until the sensors are put right. Edges between LiDARs
    are left out: they have no windows, but are registered at their own times."""
    if rig is None or rig.event is None or rig.event.corrected:
        return ()
    pairs = pairs_of(rig.graph, rig.event.sensors)
    return tuple(name for name in pairs if name not in rig.windows and name not in rig.graph.of_lidars)
