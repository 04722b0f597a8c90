"""How long a pair has been watched, and what became of its alarms: false ones are counted, not claimed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coec.calibration.lifecycle.states import HealthState

GAP_NS = 60_000_000_000
"""Sensor time, ns. Between two completed checks farther apart nobody watched: twelve periods of the monitor as it is
shipped, and more than a stretched one waits."""


@dataclass(frozen=True, slots=True)
class AlarmRecord:
    """Since the state directory is the pair's.

    Attributes:
        watched_ns: sensor time between completed checks.
        confirmed: alarms (`miscalibrated`) that ended with another extrinsic.
        withdrawn: alarms that ended with the extrinsic that they accused, and `healthy`: false ones.
        accused: whether an alarm has not ended yet.
    """

    watched_ns: int = 0
    confirmed: int = 0
    withdrawn: int = 0
    accused: bool = False

    def watched(self, from_ns: int | None, to_ns: int | None) -> AlarmRecord:
        """A check was completed at one sensor time, the one before it at another; None where that is not known."""
        if from_ns is None or to_ns is None or not 0 < to_ns - from_ns <= GAP_NS:
            return self
        return replace(self, watched_ns=self.watched_ns + to_ns - from_ns)

    def entered(self, health: HealthState, *, replaced: bool) -> AlarmRecord:
        """The pair is in a state of health now; its extrinsic was or was not replaced on the way there."""
        miscalibrated = health is HealthState.MISCALIBRATED
        if self.accused and replaced:
            return replace(self, confirmed=self.confirmed + 1, accused=miscalibrated)
        if self.accused and health is HealthState.HEALTHY:
            return replace(self, withdrawn=self.withdrawn + 1, accused=False)
        return self if self.accused or not miscalibrated else replace(self, accused=True)
