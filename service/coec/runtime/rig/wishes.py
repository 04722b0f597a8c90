"""Of which pairs a window is wanted soon: a sensor was named, and one correction for all of its pairs waits for a
window of each. A pair that suspects nothing itself would come to one with its ordinary slice, minutes later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from coec.calibration.rig.vehicle import VehicleRig, pairs_of


@dataclass(frozen=True, slots=True)
class Wish:
    """A window of a pair is wanted.

    Attributes:
        since_ns: of pairs of frames since this sensor time: those before it are of another mount.
        from_ns: it counts from this sensor time on.
    """

    since_ns: int
    from_ns: int


def wishes(before: VehicleRig | None, rig: VehicleRig | None, from_ns: int) -> Mapping[str, Wish]:
    """By pair, what is wanted of it now and was not before; it counts from a sensor time on."""
    if rig is None or rig.event is None:
        return {}
    known = _awaited(before)
    return {name: Wish(rig.event.stepped_ns, from_ns) for name in _awaited(rig) if name not in known}


def _awaited(rig: VehicleRig | None) -> tuple[str, ...]:
    """Pairs of the sensors that moved, while they are not put right, that have no window of after the move. Two LiDARs
    have no windows: they are registered, in their own time."""
    if rig is None or rig.event is None or rig.event.corrected:
        return ()
    pairs = pairs_of(rig.graph, rig.event.sensors)
    return tuple(name for name in pairs if name not in rig.windows and name not in rig.graph.of_lidars)
