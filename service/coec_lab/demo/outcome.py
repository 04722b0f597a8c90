"""Whether the story came true: right before the knock, alarm after it, then repaired."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from coec_lab.demo.watch import ALARM, Moment


@dataclass(frozen=True, slots=True)
class Ending:
    """The outcome of the drive, in seconds of driving; None for what did not happen.

    Attributes:
        false_alarm_s: the first alarm before the knock while the extrinsic was right.
        alarm_s: the first alarm after the knock.
        repaired_s: when, after the alarm, the service had an estimate of its own within the limit and was healthy.
        error_before_deg: largest error of the served extrinsic after the knock, which is that before the repair.
        error_after_deg: error at the end.
    """

    knock_s: float
    false_alarm_s: float | None
    alarm_s: float | None
    repaired_s: float | None
    error_before_deg: float
    error_after_deg: float
    health: str

    @property
    def passed(self) -> bool:
        """Whether the whole story came true, and the service is healthy at the end."""
        return not self.objections()

    def objections(self) -> tuple[str, ...]:
        """What did not come true, one sentence each."""
        said = []
        if self.false_alarm_s is not None:
            said.append(f"The service raised an alarm at {self.false_alarm_s:.0f} s, before the knock.")
        if self.alarm_s is None:
            said.append("The service never noticed the knock.")
        elif self.repaired_s is None:
            said.append("The service noticed the knock, and did not repair it.")
        elif self.health != "healthy":
            said.append(f"The service repaired the knock, and is {self.health} at the end.")
        return tuple(said)


def outcome_of(timeline: Sequence[Moment], knock_s: float, max_error_deg: float) -> Ending:
    """The outcome of a timeline that is not empty.

    Args:
        timeline: ascending in time.
        knock_s: second of the drive at which the mount was knocked.
        max_error_deg: an estimate counts as a repair only if it is nearer to the truth than this, also at the end.
    """
    # An alarm about the workshop's calibration, which is served first and is wrong, is no false alarm.
    false = (m for m in timeline if m.health == ALARM and m.drive_s < knock_s and m.error_deg < max_error_deg)
    late = [moment for moment in timeline if moment.drive_s >= knock_s]
    alarm_s = next((moment.drive_s for moment in late if moment.health == ALARM), None)
    last = timeline[-1]
    repaired = (
        moment.drive_s
        for moment in late
        if alarm_s is not None and moment.drive_s >= alarm_s and is_repaired(moment, max_error_deg)
    )
    return Ending(
        knock_s=knock_s,
        false_alarm_s=next((moment.drive_s for moment in false), None),
        alarm_s=alarm_s,
        repaired_s=next(repaired, None) if last.error_deg < max_error_deg else None,
        error_before_deg=max((moment.error_deg for moment in late), default=last.error_deg),
        error_after_deg=last.error_deg,
        health=last.health,
    )


def is_repaired(moment: Moment, max_error_deg: float) -> bool:
    """Whether the service is healthy and serves an estimate of its own within the limit of the truth."""
    return moment.health == "healthy" and moment.provenance == "estimated" and moment.error_deg < max_error_deg
