"""Lines of the timeline, and extrinsics drawn on the image: for a service, answering or not, and for a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from coec.adapters.files.conversions import degrees_or_null
from coec.adapters.foxglove.shown import Extrinsic
from coec.adapters.foxglove.timeline import NOT_SERVED, RECORDED, SILENT, Ages, Axes, Figure, Missed, Moment
from coec.adapters.foxglove.topics import Pose
from coec.calibration.types import Matrix4, Rig
from coec.cli.view.candidate import Candidate
from coec.geometry import se3
from coec.schemas.replies import AxisReply, ExtrinsicReply, HealthReply, MetricReply

STALE: Final = 3
"""ROS level of an unknown state."""

SILENT_S = 10.0
"""A service without an answer for so long, five queries, counts as silent."""

SENTENCES = {
    NOT_SERVED: "Nobody serves the pair: its service is down, or its router is.",
    SILENT: "The service is there, and does not answer.",
    RECORDED: "A recording: no service looks at it.",
}
"""Explanations of the states that are not states of health."""


@dataclass(frozen=True, slots=True)
class Said:
    """What a service last said about a pair.

    Attributes:
        alive: whether its liveliness token is there.
        answer_age_s: time since it last said anything; None: it never did.
        served, candidate: (4, 4) T_camera_lidar of `extrinsic`, checked to be rigid.
    """

    alive: bool = False
    answer_age_s: float | None = None
    health: HealthReply | None = None
    extrinsic: ExtrinsicReply | None = None
    served: Matrix4 | None = None
    candidate: Matrix4 | None = None

    @property
    def state(self) -> str:
        """State of the pair: that of its health, as long as the service is there and answers."""
        if not self.alive:
            return NOT_SERVED
        if self.health is None or self.answer_age_s is None or self.answer_age_s > SILENT_S:
            return SILENT
        return self.health.state


def moment_of_service(
    pair: str, said: Said, ages_s: Mapping[str, float | None], not_shown: Counter[tuple[str, str]]
) -> Moment:
    """The line for a service and its sensors. `ages_s` is the time since a frame came, by stream; `not_shown` counts
    frames by stream and cause. Figures are the last known ones, whatever the state; `answer_s` is their age."""
    health, extrinsic = said.health, said.extrinsic
    current = health is not None and said.state == health.state
    return Moment(
        pair=pair,
        state=said.state,
        level=health.level if health is not None and current else STALE,
        why=" ".join(one.text for one in health.reasons) if health and current else SENTENCES[said.state],
        reasons=tuple(one.code for one in health.reasons) if health and current else (said.state,),
        needs=health.needs if health else (),
        provenance=extrinsic.provenance if extrinsic else None,
        status=extrinsic.status if extrinsic else None,
        percent_complete=extrinsic.percent_complete if extrinsic else None,
        candidate=said.candidate is not None,
        ages=Ages(
            camera_s=ages_s.get("camera"),
            lidar_s=ages_s.get("lidar"),
            ego_s=ages_s.get("ego"),
            answer_s=said.answer_age_s,
        ),
        pair_rate_hz=health.data_quality.pair_rate_hz if health else None,
        sync_error_s=health.data_quality.sync_error_s if health else None,
        correction=_axes([one.correction for one in _replies(extrinsic)]),
        sigma=_axes([one.sigma for one in _replies(extrinsic)]),
        step=_axes(extrinsic.pending.step or () if extrinsic and extrinsic.pending else ()),
        figures=_figures(health.metrics if health else {}),
        not_shown=tuple(
            Missed(stream=stream, cause=cause, count=count) for (stream, cause), count in sorted(not_shown.items())
        ),
    )


def extrinsics_of_service(rig: Rig, said: Said) -> dict[Pose, Extrinsic]:
    """The extrinsics that are drawn while a service is watched."""
    provenance = said.extrinsic.provenance if said.extrinsic else "not known"
    pending = said.extrinsic.pending if said.extrinsic else None
    waits = pending.waits.code if pending and pending.waits else "waits for apply"
    return {
        Pose.SERVED: Extrinsic(said.served, f"served: {provenance}, {said.state}"),
        Pose.NOMINAL: Extrinsic(rig.T_camera_lidar_nominal, "nominal: of the configuration"),
        Pose.CANDIDATE: Extrinsic(
            said.candidate, f"candidate: {'none' if said.candidate is None else waits}"
        ),
    }  # fmt: skip


def moment_of_recording(rig: Rig, served: Matrix4, found: Candidate | None) -> Moment:
    """The line for a recording and the result that was found with it."""
    result = found.result if found else None
    return Moment(
        pair=rig.pair,
        state=RECORDED,
        level=STALE,
        why=" ".join(one.text for one in result.verdict.reasons) if result else SENTENCES[RECORDED],
        reasons=tuple(one.code for one in result.verdict.reasons) if result else (RECORDED,),
        provenance="nominal" if np.array_equal(served, rig.T_camera_lidar_nominal) else "restored",
        status=result.status if result else None,
        candidate=found is not None,
        correction=_axes(degrees_or_null(se3.difference(served, rig.T_camera_lidar_nominal))),
        sigma=_axes(result.sigma if result else ()),
        step=_axes(degrees_or_null(se3.difference(found.T_camera_lidar, served)) if found else ()),
        figures=_figures(result.metrics if result else {}),
    )


def extrinsics_of_recording(rig: Rig, served: Matrix4, found: Candidate | None) -> dict[Pose, Extrinsic]:
    """The extrinsics that are drawn while a recording is played."""
    return {
        Pose.SERVED: Extrinsic(served, "served: when this was recorded"),
        Pose.NOMINAL: Extrinsic(rig.T_camera_lidar_nominal, "nominal: of the recording"),
        Pose.CANDIDATE: (
            Extrinsic(found.T_camera_lidar, f"candidate: {found.result.status}")
            if found
            else Extrinsic(None, "candidate: none")
        ),
    }


def _replies(extrinsic: ExtrinsicReply | None) -> Iterable[AxisReply]:
    if extrinsic is None:
        return ()
    axes = extrinsic.axes
    return (axes.rx, axes.ry, axes.rz, axes.tx, axes.ty, axes.tz)


def _axes(values: Sequence[float | None]) -> Axes:
    """Axes from six values, degrees and metres, or from none."""
    return Axes(**dict(zip(Axes.model_fields, values, strict=False)))


def _figures(metrics: Mapping[str, MetricReply]) -> tuple[Figure, ...]:
    return tuple(
        Figure(name=name, value=one.value, limit=one.limit, passed=one.passed) for name, one in sorted(metrics.items())
    )
