"""When a pair is looked at, and what may be done about what was seen."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.base import Stage


class MonitorConfig(Stage):
    """When the latest pairs are judged at the current extrinsic, between two windows."""

    period_s: float = Field(default=5.0, gt=0, le=86_400, description="one check per so much sensor time, s")
    pairs: int = Field(default=6, ge=4, le=10, description="pairs of one check, evenly over the period")
    min_pairs: int = Field(default=4, ge=4, le=10, description="with fewer the check waits for the next period")
    urgent_slice_s: float = Field(
        default=30.0, gt=0, le=3600, description="slice of the window that is taken as soon as the monitor suspects, s"
    )
    hours_between_false_alarms: float = Field(
        default=100.0, gt=0, description="a right mount is called moved by checks once in so many hours, or more rarely"
    )
    hours_between_false_suspicions: float = Field(
        default=2.0, gt=0, description="a right mount is suspected once in so many hours, or more rarely"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> MonitorConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        if self.hours_between_false_suspicions > self.hours_between_false_alarms:
            raise ValueError("hours_between_false_suspicions must not exceed hours_between_false_alarms")
        return self


class PolicyConfig(Stage):
    """What may become current without a person: an estimate is one thing, applying it another. What is not applied
    waits for `command/apply`. Limits are per axis; those of a day count every step of the last 24 h of sensor time."""

    apply: Literal["never", "within_limits", "always"] = Field(
        default="within_limits",
        description="of an accepted estimate that differs: by a person, by the limits below, or at once",
    )
    max_step_deg: float = Field(default=10.0, gt=0, description="largest step of a rotation, degrees (within_limits)")
    max_step_m: float = Field(default=0.3, gt=0, description="largest step of a translation, m (within_limits)")
    max_per_day_deg: float = Field(default=20.0, gt=0, description="sum of all steps of a day, degrees (within_limits)")
    max_per_day_m: float = Field(default=0.6, gt=0, description="sum of all steps of a day, m (within_limits)")
    agree_deg: float = Field(
        default=0.3, gt=0, description="an accepted estimate nearer than this confirms what is served, degrees"
    )
    agree_m: float = Field(default=0.1, gt=0, description="an accepted estimate nearer than this confirms it, m")
