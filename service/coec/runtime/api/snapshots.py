"""From the state of a pair to the replies that are served: pure functions, and a reply serialised in both encodings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees
from typing import Any, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from coec.adapters.files.conversions import transform_of
from coec.adapters.zenoh.bus import JSON, MSGPACK, Answer
from coec.calibration.lifecycle import PairState, Status
from coec.calibration.lifecycle.policy import step_between
from coec.calibration.types import Reason, Rig
from coec.config import TrackerConfig
from coec.runtime.worker.jobs import Fate
from coec.runtime.worker.supervisor import Worker, WorkerState
from coec.schemas import replies
from coec.schemas.base import to_json, to_msgpack
from coec.schemas.keys import Format
from coec.schemas.replies import CalibrationResult

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
UNITS: tuple[Literal["deg", "m"], ...] = ("deg", "deg", "deg", "m", "m", "m")


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A reply, serialised before anyone asks."""

    msgpack: bytes
    json: bytes

    @classmethod
    def of(cls, model: BaseModel) -> Snapshot:
        """Both encodings of the model."""
        return cls(to_msgpack(model), to_json(model))

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> Snapshot:
        """Both encodings of JSON-like values that have no model of their own."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        return cls(msgpack.packb(json.loads(text)), text.encode())

    def answer(self, form: Format) -> Answer:
        """The one that was asked for."""
        return Answer(self.json, JSON) if form == "json" else Answer(self.msgpack, MSGPACK)


def answer_of(model: BaseModel, form: Format) -> Answer:
    """A model in the encoding that was asked for."""
    return Answer(to_json(model), JSON) if form == "json" else Answer(to_msgpack(model), MSGPACK)


def axes_of(result: CalibrationResult | None, status: Status) -> replies.Axes:
    """Correction and spread per axis, of a result or of the nominal calibration (None)."""

    def axis(index: int) -> replies.AxisReply:
        if result is None:
            return replies.AxisReply(status="not_accepted", sigma=None, correction=0.0, unit=UNITS[index])
        return replies.AxisReply(
            status=_axis_status(result, index, status),
            sigma=result.sigma[index],
            correction=result.correction[index],
            unit=UNITS[index],
        )

    return replies.Axes(rx=axis(0), ry=axis(1), rz=axis(2), tx=axis(3), ty=axis(4), tz=axis(5))


def _axis_status(result: CalibrationResult, index: int, status: Status) -> replies.AxisStatus:
    if result.unobservable[index]:
        return "not_observable"
    return status.value if result.solved[index] else "not_solved"


def extrinsic_of(
    vehicle: str,
    rig: Rig,
    state: PairState,
    accepted: CalibrationResult | None,
    percent_complete: float,
    config_hash: str,
    tracker: TrackerConfig,
) -> replies.ExtrinsicReply:
    """What to use now. `accepted` is `state.accepted` in its wire form; `config_hash` is said while there is none."""
    return replies.ExtrinsicReply(
        vehicle=vehicle,
        pair=rig.pair,
        camera_frame=rig.camera_frame,
        lidar_frame=rig.lidar_frame,
        camera_from_lidar=transform_of(state.T_camera_lidar),
        provenance=state.provenance.value,
        status=state.status.value,
        percent_complete=percent_complete,
        axes=axes_of_served(state, rig, accepted, tracker),
        valid_from_ns=state.valid_from_ns,
        data_stamp_ns=accepted.data_stamp_ns if accepted else None,
        window_id=accepted.window_id if accepted else None,
        config_hash=accepted.config_hash if accepted else config_hash,
        pending=candidate_of(state) if state.pending else None,
        held=state.frozen,
    )


def candidate_of(state: PairState) -> replies.Candidate | None:
    """What waits for `apply`; None when nothing does."""
    if state.pending is None:
        return None
    pending = state.pending
    return replies.Candidate(
        window_id=pending.estimate.window_id,
        data_stamp_ns=pending.estimate.data_stamp_ns,
        camera_from_lidar=transform_of(pending.T_camera_lidar),
        step=degrees_and_metres(step_between(state.T_camera_lidar, pending.T_camera_lidar)),
        waits=replies.Reason(code=pending.waits.code, text=pending.waits.text),
    )


def degrees_and_metres(rad_m: NDArray[np.float64]) -> replies.Vector6:
    """(6,) in the units of the wire."""
    a, b, c, x, y, z = (float(value) for value in rad_m)
    return degrees(a), degrees(b), degrees(c), x, y, z


def axes_of_served(
    state: PairState, rig: Rig, accepted: CalibrationResult | None, tracker: TrackerConfig
) -> replies.Axes:
    """Correction and spread per axis of what is served: the track's where it holds more than one window."""
    axes = axes_of(accepted, Status.ACCEPTED)
    if accepted is None or state.track is None or state.track.windows <= 1:
        return axes
    correction = degrees_and_metres(step_between(rig.T_camera_lidar_nominal, state.T_camera_lidar))
    sigma = degrees_and_metres(state.track.sigma(tracker))
    told = {
        name: getattr(axes, name).model_copy(
            update={"correction": correction[index], "sigma": sigma[index] if accepted.solved[index] else None}
        )
        for index, name in enumerate(AXES)
    }
    return replies.Axes(**told)


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


def worker_status_of(worker: Worker) -> replies.WorkerStatus:
    """The worker as `status` tells it."""
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
        pid=worker.pid,
        restarts=max(status.starts - 1, 0),
        queued=sum(status.waiting.values()),
        waiting=dict(status.waiting),
        job=None if job is None else job.kind,
        job_age_s=None if job is None else job.age_s,
        outcomes={fate.value: status.outcomes.get(fate, 0) for fate in Fate},
        losses=dict(status.losses),
        faults={fault.value: count for fault, count in status.faults.items()},
    )
