"""Replies about a pair, made from its state and its counters: `extrinsic`, also in the form that exports need,
`health` and `status`; and replies that are serialised in advance. `status` of the worker and of the budget, too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import msgpack
import numpy as np
from pydantic import BaseModel

import coec
from coec.calibration.baseline import BaselineDrift
from coec.calibration.state import CalibrationStatus, Health, PairState, Provenance
from coec.calibration.state_machine import AlarmRecord, HealthState, step_between
from coec.calibration.types import NS_PER_S, Decision, Estimate, Reason, Rig, Uncertainty
from coec.config import CameraIntrinsics, PairConfig
from coec.geometry import se3
from coec.io import serialise
from coec.io.exported_extrinsic import NOMINAL, ExportedExtrinsic, ExportFrames, ExtrinsicOrigin, between_frames
from coec.io.zenoh.bus import JSON, MSGPACK, Answer
from coec.schemas import replies
from coec.schemas.keys import Format
from coec.schemas.message import to_json, to_msgpack
from coec.service.cpu_budget import BudgetReport
from coec.service.engine.messages import PairSnapshot
from coec.service.engine.pair import HELD
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR, StreamCounts
from coec.service.ingest.inbox import Arrivals
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.worker import compilation
from coec.service.worker.supervisor import Worker, WorkerState
from coec.service.worker.worker_jobs import Fate


def axes_of(result: replies.CalibrationResult | None, status: CalibrationStatus) -> replies.Axes:
    """Correction and standard deviation per axis, of a result or (None) of the nominal calibration."""

    def axis(index: int) -> replies.AxisReply:
        if result is None:
            return replies.AxisReply(status="not_accepted", sigma=None, correction=0.0, unit=replies.UNITS[index])
        return replies.AxisReply(
            status=_axis_status(result, index, status),
            sigma=result.sigma[index],
            correction=result.correction[index],
            unit=replies.UNITS[index],
        )

    return replies.Axes(rx=axis(0), ry=axis(1), rz=axis(2), tx=axis(3), ty=axis(4), tz=axis(5))


def _axis_status(result: replies.CalibrationResult, index: int, status: CalibrationStatus) -> replies.AxisStatus:
    if result.unobservable[index]:
        return "not_observable"
    return status.value if result.solved[index] else "not_solved"


def extrinsic_of(
    vehicle: str,
    rig: Rig,
    state: PairState,
    accepted: replies.CalibrationResult | None,
    percent_complete: float,
    config_hash: str,
) -> replies.ExtrinsicReply:
    """The calibration to use now. `accepted` is `state.accepted` in its wire form; `config_hash` is used while there is
    none."""
    of, cloud = uncertainty_of_served(state), rig.cloud
    return replies.ExtrinsicReply(
        vehicle=vehicle,
        pair=rig.pair,
        camera_frame=rig.camera_frame,
        lidar_frame=rig.lidar_frame,
        camera_from_lidar=serialise.transform_of(state.T_camera_lidar),
        cloud_frame=None if cloud is None else cloud.frame_id,
        camera_from_cloud=None
        if cloud is None
        else serialise.transform_of(state.T_camera_lidar @ se3.inverse(cloud.T_cloud_lidar)),
        provenance=state.provenance.value,
        status=state.status.value,
        percent_complete=percent_complete,
        axes=axes_of_served(state, rig, accepted),
        correlation_pitch_height=None if of is None else serialise.number_or_null(of.pitch_height),
        correlation_yaw_side=None if of is None else serialise.number_or_null(of.yaw_side),
        valid_from_ns=state.valid_from_ns,
        data_stamp_ns=accepted.data_stamp_ns if accepted else None,
        window_id=accepted.window_id if accepted else None,
        config_hash=accepted.config_hash if accepted else config_hash,
        pending=serialise.candidate_of(state) if state.pending else None,
        held=state.hold is not None,
        hold=hold_of(state),
        intrinsics=serialise.intrinsics_of(rig.camera),
    )


def hold_of(state: PairState) -> replies.Hold | None:
    """Who holds the served extrinsic; None if nobody does."""
    hold = state.hold
    if hold is None:
        return None
    return replies.Hold(since_ns=hold.since_ns, sender=hold.sender, reason=hold.reason or None)


def uncertainty_of_served(state: PairState) -> Uncertainty | None:
    """Uncertainty of what is served: that of the track if it holds more than one window, else that of the accepted
    window. None while nothing was accepted."""
    if state.accepted is None:
        return None
    return state.accepted.uncertainty if state.track is None or state.track.windows <= 1 else state.track.uncertainty


def axes_of_served(state: PairState, rig: Rig, accepted: replies.CalibrationResult | None) -> replies.Axes:
    """Correction and standard deviation per axis of what is served: those of the track if it holds more than one
    window."""
    axes = axes_of(accepted, CalibrationStatus.ACCEPTED)
    if accepted is None or state.track is None or state.track.windows <= 1:
        return axes
    correction = serialise.degrees_and_metres(step_between(rig.T_camera_lidar_nominal, state.T_camera_lidar))
    sigma = serialise.degrees_and_metres(state.track.uncertainty.sigma)
    updated = {
        name: getattr(axes, name).model_copy(
            update={"correction": correction[index], "sigma": sigma[index] if accepted.solved[index] else None}
        )
        for index, name in enumerate(replies.AXES)
    }
    return replies.Axes(**updated)


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
        problems: troubles of the whole service, of the pair's streams, or of its recorder.
        missed: sentences about streams that nobody sends.
    """
    latest = known.state.latest
    result = None if latest is None else serialise.result_of(latest, rig, vehicle)
    health = with_problems(Health(known.state.health, known.state.reasons), (*known.problems, *problems))
    drift, result_drift = known.drift, known.result_drift
    return replies.HealthReply(
        vehicle=vehicle,
        pair=pair.name,
        state=health.state.value,
        level=replies.ROS_LEVELS[health.state.value],
        reasons=serialise.reasons_of(health.reasons),
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
        intrinsics=_lens_drift(result),
    )


def _lens_drift(result: replies.CalibrationResult | None) -> replies.LensDrift | None:
    """The lens according to the latest window. Nothing applies it: the configuration has the intrinsics."""
    if result is None or result.lens is None:
        return None
    return replies.LensDrift(**dict(result.lens), window_id=result.window_id, data_stamp_ns=result.data_stamp_ns)


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
    return None if drift is None else serialise.degrees_or_null(drift.value)


def _sigma(drift: BaselineDrift | None) -> replies.Maybe6 | None:
    return None if drift is None else serialise.degrees_or_null(drift.sigma)


def exported(
    state: PairState,
    vehicle: str,
    pair: str,
    own: tuple[str, str],
    camera: CameraIntrinsics | None,
    frames: ExportFrames,
) -> ExportedExtrinsic:
    """The extrinsic of a state with its whole covariance; `own` are the frames of the LiDAR and the camera. The only
    possible objection to it is that it is still the nominal calibration."""
    accepted, uncertainty = state.accepted, uncertainty_of_served(state)
    origin = ExtrinsicOrigin(
        vehicle=vehicle,
        pair=pair,
        version=coec.__version__,
        provenance=state.provenance.value,
        window_id=None if accepted is None else accepted.window_id,
        data_stamp_ns=None if accepted is None else accepted.data_stamp_ns,
        config_hash=None if accepted is None else accepted.config_hash,
        rejection_reasons=(NOMINAL,) if state.provenance is Provenance.NOMINAL else (),
    )
    covariance = np.full((6, 6), np.nan) if uncertainty is None else uncertainty.covariance
    return between_frames(state.T_camera_lidar, covariance, own, frames, camera, origin)


def pair_status_of(
    name: str,
    known: PairSnapshot,
    report: StreamStatistics,
    losses: Mapping[tuple[str, str], int],
    recorded: int,
    commands: dict[str, int],
    arrivals: Mapping[str, Arrivals],
    unwritten: int,
    *,
    has_ego: bool,
) -> replies.PairStatus:
    """Status of a pair. `losses` are its losses by place and cause, `recorded` the number of its windows on the disk,
    `unwritten` the number of pairs that wait for the disk."""
    drops, selection = drops_of(losses, report.unpaired), report.selection

    def stream(name: str) -> replies.StreamStatus:
        counts = report.streams.get(name, StreamCounts(0, 0))
        arrival = arrivals[name]
        return replies.StreamStatus(
            received=counts.received,
            accepted=counts.accepted,
            waiting=arrival.waiting,
            age_s=arrival.age_s,
            losses=drops.get(name, {}),
        )

    return replies.PairStatus(
        name=name,
        camera=stream(CAMERA),
        lidar=stream(LIDAR),
        ego=stream(EGO) if has_ego else None,
        pairs=report.pairs,
        held=report.held,
        unanswered=selection.unanswered,
        selected=selection.selected,
        unwritten=unwritten,
        rejections=dict(selection.rejections),
        losses={**drops.get("window", {}), **drops.get("storage", {}), **drops.get("monitor", {})},
        windows=recorded,
        solved=known.solved,
        checks=known.checks,
        transitions=dict(known.transitions),
        commands=commands,
    )


def worker_status_of(worker: Worker) -> replies.WorkerStatus:
    """Status of the worker."""
    status = worker.status()
    states: dict[WorkerState, Literal["starting", "idle", "busy", "stopped"]] = {
        WorkerState.STARTING: "starting",
        WorkerState.READY: "idle",
        WorkerState.BUSY: "busy",
        WorkerState.STOPPED: "stopped",
    }
    job = status.in_progress
    return replies.WorkerStatus(
        state=states[status.state],
        compiling=None
        if status.compiling is None
        else replies.CompilingStatus(
            done=status.compiling.done, total=status.compiling.total, elapsed_s=status.compiling.elapsed_s
        ),
        pid=worker.pid,
        restarts=max(status.starts - 1, 0),
        queued=sum(status.waiting.values()),
        waiting=dict(status.waiting),
        job=None if job is None else job.kind,
        job_age_s=None if job is None else job.age_s,
        commissioning=dict(status.commissionings),
        outcomes={fate.value: status.outcomes.get(fate, 0) for fate in Fate},
        losses=dict(status.losses),
        faults={fault.value: count for fault, count in status.faults.items()},
    )


def budget_status_of(report: BudgetReport) -> replies.BudgetStatus:
    """Status of the budget."""
    kinds = sorted({kind for kind, _ in report.totals_s})
    return replies.BudgetStatus(
        cores=report.cores,
        spent=report.spent,
        wanted=report.demand,
        stretched_by=report.stretched_by,
        in_store_s=report.in_store_s,
        spent_s={kind: sum(cpu_s for (each, _), cpu_s in report.totals_s.items() if each == kind) for kind in kinds},
        pairs={
            name: replies.BudgetShare(
                look_s=share.check_s,
                window_s=share.window_s,
                unseen_s=report.unseen_s.get(name),
                suspected=share.suspected,
                waiting=share.waiting,
                active=share.active,
            )
            for name, share in report.pairs.items()
        },
    )


@dataclass(frozen=True, slots=True)
class SerializedReply:
    """A reply in both encodings, serialised before anyone asks."""

    msgpack: bytes
    json: bytes

    @classmethod
    def of(cls, model: BaseModel) -> SerializedReply:
        """Both encodings of the model."""
        return cls(to_msgpack(model), to_json(model))

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> SerializedReply:
        """Both encodings of JSON-like values that have no model of their own."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        return cls(msgpack.packb(json.loads(text)), text.encode())

    def answer(self, form: Format) -> Answer:
        """The reply in the encoding that was asked for."""
        return Answer(self.json, JSON) if form == "json" else Answer(self.msgpack, MSGPACK)


def answer_of(model: BaseModel, form: Format) -> Answer:
    """A model in the encoding that was asked for."""
    return Answer(to_json(model), JSON) if form == "json" else Answer(to_msgpack(model), MSGPACK)
