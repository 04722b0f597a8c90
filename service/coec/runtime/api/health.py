"""The answer to `health`: the state of a pair with its reasons and figures."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from coec.adapters.files.conversions import degrees_or_null, result_of
from coec.calibration.commissioning.baseline import BaselineDrift
from coec.calibration.lifecycle import AlarmRecord, Health, HealthState
from coec.calibration.types import Decision, Estimate, Reason, Rig
from coec.config import PairConfig
from coec.runtime.api.extrinsic import axes_of
from coec.runtime.decisions.decider import HELD, PairSnapshot
from coec.runtime.ingest.decoder import EGO
from coec.runtime.ingest.sensor_clock import NS_PER_S
from coec.runtime.ingest.stream_statistics import StreamStatistics
from coec.runtime.worker import compilation
from coec.schemas import replies

HARMLESS = frozenset({HELD, "rival_unproven", compilation.CODE})
"""Codes of troubles that leave a healthy pair healthy: a hold; a token that any program could declare, which could else
take the calibration away from all consumers; and kernels that are compiled, for instance for a new pair. If checks fail
to come because of that, the pair is `overdue_worker`."""

OLD_S = 5.0
"""Oldest reply that is still true, s. The thread that makes one every second must be stuck if the reply is older."""


@dataclass(frozen=True, slots=True)
class StampedReply:
    """A reply, and the time (steady clock) at which it was made."""

    reply: replies.HealthReply
    monotonic_s: float

    def now(self) -> replies.HealthReply:
        """The reply if it is not too old; else one that says that it is, and is not green."""
        age_s = time.monotonic() - self.monotonic_s
        if age_s <= OLD_S:
            return self.reply
        state = self.reply.state if self.reply.state != HealthState.HEALTHY.value else HealthState.DEGRADED.value
        text = (
            f"What the service knows of this pair has not been renewed for {age_s:.0f} s: a disk or a thread is stuck."
        )
        stuck = replies.Reason(code=replies.SERVICE_STUCK, text=text)
        return self.reply.model_copy(
            update={"state": state, "level": replies.ROS_LEVELS[state], "reasons": (*self.reply.reasons, stuck)}
        )


def health_of(
    known: PairSnapshot,
    report: StreamStatistics,
    losses: Mapping[tuple[str, str], int],
    problems: tuple[Reason, ...],
    missed: tuple[str, ...],
    pair: PairConfig,
    rig: Rig,
    vehicle: str,
) -> replies.HealthReply:
    """The health of a pair.

    Args:
        losses: losses of the pair, by place and cause.
        troubles: troubles of the whole service, of the pair's streams, or of its recorder.
        missed: sentences about streams that nobody sends.
    """
    latest = known.state.latest
    result = None if latest is None else result_of(latest, rig, vehicle)
    health = with_problems(Health(known.state.health, known.state.reasons), (*known.problems, *problems))
    drift, result_drift = known.drift, known.result_drift
    return replies.HealthReply(
        vehicle=vehicle,
        pair=pair.name,
        state=health.state.value,
        level=replies.ROS_LEVELS[health.state.value],
        reasons=reasons_of(health.reasons),
        metrics={**(result.metrics if result else {}), **(known.check.metrics if known.check else {})},
        axes=axes_of(result, known.state.status),
        drift=_value(drift),
        drift_sigma=_sigma(drift),
        result_drift=_value(result_drift),
        result_drift_sigma=_sigma(result_drift),
        check=known.check,
        needs=(*missed, *needs_of(report, pair, latest)),
        data_quality=data_quality_of(report, losses),
        since_ns=known.since_ns,
        evaluated_ns=known.completed_stamp_ns,
        age_s=known.age_s,
        alarms=_alarms_of(known.state.record),
    )


def _alarms_of(record: AlarmRecord) -> replies.Alarms:
    return replies.Alarms(
        watched_s=record.watched_ns / NS_PER_S,
        confirmed=record.confirmed,
        withdrawn=record.withdrawn,
        open=record.accused,
    )


def with_problems(health: Health, problems: tuple[Reason, ...]) -> Health:
    """The health with troubles of the service added to its reasons. They make a healthy pair degraded, except for
    those that say nothing about its calibration."""
    if not problems:
        return health
    worse = health.state is HealthState.HEALTHY and any(reason.code not in HARMLESS for reason in problems)
    return Health(HealthState.DEGRADED if worse else health.state, (*health.reasons, *problems))


def needs_of(report: StreamStatistics, pair: PairConfig, latest: Estimate | None) -> tuple[str, ...]:
    """What is still missing, one sentence each. `latest` is the last estimate."""
    needs = []
    lacking = pair.window.min_pairs - report.selection.selected
    if lacking > 0:
        needs.append(f"{lacking} more pairs")
    if latest is not None and latest.verdict.decision is Decision.FAILED:
        needs += [f"a better window: {reason.text}" for reason in latest.verdict.reasons]
    if pair.calibration.motion_compensation:
        ego = report.streams.get(EGO)
        if pair.ego is None or (report.pairs and (ego is None or not ego.accepted)):
            needs.append("motion compensation has no ego-motion")
        elif latest is not None and latest.compensation.get("no_point_time", 0):
            needs.append("motion compensation has no point times")
        elif latest is not None and latest.compensation.get("rotation_only", 0):
            needs.append("motion compensation has no linear velocity: rotation is compensated, translation is not")
    return tuple(needs)


def data_quality_of(report: StreamStatistics, losses: Mapping[tuple[str, str], int]) -> replies.DataQuality:
    """The quality of the streams."""
    selection, quality = report.selection, report.selection.quality
    drops = drops_of(losses, report.unpaired)
    if selection.rejections:
        drops["pairs"] = dict(selection.rejections)
    return replies.DataQuality(
        pair_rate_hz=report.rate_hz,
        sync_error_s=report.sync_error_s,
        drops=drops,
        sharpness=quality.sharpness if quality else None,
        mean_level=quality.mean_level if quality else None,
        clipped=quality.clipped if quality else None,
        frozen_image=selection.frozen,
        point_times=report.timed_by,
    )


def reasons_of(reasons: tuple[Reason, ...]) -> tuple[replies.Reason, ...]:
    """Reasons in their wire form."""
    return tuple(replies.Reason(code=reason.code, text=reason.text) for reason in reasons)


def drops_of(losses: Mapping[tuple[str, str], int], unpaired: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Losses by place, then by cause. `unpaired` is the pairer's count by `<stream>_<cause>`."""
    drops: dict[str, dict[str, int]] = {}
    for (place, cause), count in losses.items():
        drops.setdefault(place, {})[cause] = count
    for name, count in unpaired.items():
        stream, _, cause = name.partition("_")
        place = "ego" if stream == "motion" else stream
        drops.setdefault(place, {})[cause] = drops.get(place, {}).get(cause, 0) + count
    return drops


def _value(drift: BaselineDrift | None) -> replies.Maybe6 | None:
    return None if drift is None else degrees_or_null(drift.value)


def _sigma(drift: BaselineDrift | None) -> replies.Maybe6 | None:
    return None if drift is None else degrees_or_null(drift.sigma)
