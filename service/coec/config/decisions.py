"""When a pair is checked, and which estimates may be applied without a person."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.base import ConfigModel


class MonitorConfig(ConfigModel):
    """When the monitor checks the latest pairs at the current extrinsic, between two windows."""

    period_s: float = Field(default=5.0, gt=0, le=86_400, description="sensor time from one check to the next, s")
    pairs: int = Field(default=6, ge=4, le=10, description="frame pairs of one check, spread evenly over the period")
    min_pairs: int = Field(default=4, ge=4, le=10, description="with fewer, the check waits for the next period")
    urgent_slice_s: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="length of the slice that starts as soon as the monitor suspects a move, s",
    )
    hours_between_false_alarms: float = Field(
        default=100.0,
        gt=0,
        description="least mean time between two false alarms of the checks on a mount that has not moved, h",
    )
    hours_between_false_suspicions: float = Field(
        default=2.0, gt=0, description="least mean time between two false suspicions on a mount that has not moved, h"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> MonitorConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        if self.hours_between_false_suspicions > self.hours_between_false_alarms:
            raise ValueError("hours_between_false_suspicions must not exceed hours_between_false_alarms")
        return self


class PolicyConfig(ConfigModel):
    """Which accepted estimates become current without a person. An estimate that is not applied waits for
    `command/apply`. Limits are per axis; the limits of a day count every step of the last 24 h of sensor time."""

    apply: Literal["never", "within_limits", "always"] = Field(
        default="within_limits",
        description="when an accepted estimate that differs is applied: only by a person, if it is within the limits "
        "below, or at once",
    )
    max_step_deg: float = Field(default=10.0, gt=0, description="largest step of a rotation, degrees (within_limits)")
    max_step_m: float = Field(default=0.3, gt=0, description="largest step of a translation, m (within_limits)")
    max_per_day_deg: float = Field(
        default=20.0, gt=0, description="largest sum of the steps of a day, degrees (within_limits)"
    )
    max_per_day_m: float = Field(default=0.6, gt=0, description="largest sum of the steps of a day, m (within_limits)")
    agree_deg: float = Field(
        default=0.3, gt=0, description="an accepted estimate nearer than this confirms the served extrinsic, degrees"
    )
    agree_m: float = Field(default=0.1, gt=0, description="the same for translations, m")
