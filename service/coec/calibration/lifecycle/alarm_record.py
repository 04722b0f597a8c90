"""How long a pair has been watched, and how its alarms ended: so false alarms are counted rather than estimated."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coec.calibration.lifecycle.states import HealthState

GAP_NS = 60_000_000_000
"""Sensor time, ns. Between two completed checks that are farther apart the pair counts as not watched. It is twelve
default periods of the monitor, and longer than a stretched period."""


@dataclass(frozen=True, slots=True)
class AlarmRecord:
    """The record since the pair got its state directory.

    Attributes:
        watched_ns: sensor time between completed checks.
        confirmed: number of alarms (`miscalibrated`) that ended with another extrinsic.
        withdrawn: number of false alarms: they ended `healthy` with the extrinsic that they accused.
        accused: whether an alarm is going on.
    """

    watched_ns: int = 0
    confirmed: int = 0
    withdrawn: int = 0
    accused: bool = False

    def watched(self, from_ns: int | None, to_ns: int | None) -> AlarmRecord:
        """The record after a check was completed at `to_ns`, and the one before it at `from_ns` (sensor time); None if
        unknown."""
        if from_ns is None or to_ns is None or not 0 < to_ns - from_ns <= GAP_NS:
            return self
        return replace(self, watched_ns=self.watched_ns + to_ns - from_ns)

    def entered(self, health: HealthState, *, replaced: bool) -> AlarmRecord:
        """The record after the pair came to a state of health; `replaced`: whether its extrinsic was replaced on the
        way there."""
        miscalibrated = health is HealthState.MISCALIBRATED
        if self.accused and replaced:
            return replace(self, confirmed=self.confirmed + 1, accused=miscalibrated)
        if self.accused and health is HealthState.HEALTHY:
            return replace(self, withdrawn=self.withdrawn + 1, accused=False)
        return self if self.accused or not miscalibrated else replace(self, accused=True)
