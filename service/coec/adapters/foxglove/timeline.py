"""Lines of a viewer's timeline, as JSON with a schema that viewers can read: plain types, every field named, and no
null (unknown values are left out)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

NOT_SERVED = "not_served"
"""State: no service serves the pair, as its liveliness token is absent."""

SILENT = "silent"
"""State: a service serves the pair but does not answer."""

RECORDED = "recorded"
"""State: there is no service; a recording is played."""


class _TimelineModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseAxes(_TimelineModel):
    """Rotation vector about, and translation along, the axes of the camera; unknown values are left out."""

    rx_deg: float | None = None
    ry_deg: float | None = None
    rz_deg: float | None = None
    tx_m: float | None = None
    ty_m: float | None = None
    tz_m: float | None = None


class StreamAges(_TimelineModel):
    """Seconds since the last frame or answer; left out if nothing has come, or if it is not listened to."""

    camera_s: float | None = None
    lidar_s: float | None = None
    ego_s: float | None = None
    answer_s: float | None = Field(default=None, description="since the last word of the service, asked for or not")


class TimelineFigure(_TimelineModel):
    """A figure of self-diagnosis with its limit."""

    name: str
    value: float | None
    limit: float | None
    passed: bool


class MissedFrames(_TimelineModel):
    """Received frames that were not shown."""

    stream: str
    cause: str
    count: int


class TimelineEntry(_TimelineModel):
    """A line of the timeline."""

    pair: str
    state: str = Field(description="state of the pair's health; or not_served, silent, recorded")
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    why: str = Field(description="sentences of the reasons")
    reasons: tuple[str, ...] = Field(default=(), description="codes of the reasons")
    needs: tuple[str, ...] = Field(default=(), description="what is still missing")
    provenance: str | None = Field(default=None, description="where the served extrinsic comes from")
    status: str | None = Field(default=None, description="status of the latest attempt, or of a recording's result")
    percent_complete: float | None = Field(default=None, description="how full the open window is")
    candidate: bool = Field(default=False, description="whether a candidate is shown")
    ages: StreamAges = StreamAges()
    pair_rate_hz: float | None = None
    sync_error_s: float | None = None
    correction: PoseAxes = Field(default=PoseAxes(), description="served extrinsic, from nominal")
    sigma: PoseAxes = Field(default=PoseAxes(), description="standard deviations of `correction`")
    step: PoseAxes = Field(default=PoseAxes(), description="candidate, from the served extrinsic")
    figures: tuple[TimelineFigure, ...] = ()
    not_shown: tuple[MissedFrames, ...] = ()

    def document(self) -> dict[str, Any]:
        """The line in the form in which it is sent."""
        return self.model_dump(mode="json", exclude_none=True)


def timeline_schema() -> dict[str, Any]:
    """JSON Schema of a `Moment`, without references and choices, which viewers do not follow."""
    whole = TimelineEntry.model_json_schema()
    plain: dict[str, Any] = _plain(whole, whole.get("$defs", {}))
    return plain | {"title": "coec.Moment"}


def _plain(node: Mapping[str, Any], parts: Mapping[str, Any]) -> dict[str, Any]:
    if "$ref" in node:
        return _plain(parts[node["$ref"].rpartition("/")[2]], parts)
    if "anyOf" in node:  # a type, or null
        (kind,) = [choice for choice in node["anyOf"] if choice.get("type") != "null"]
        return _plain({**kind, **{key: node[key] for key in ("description",) if key in node}}, parts)
    plain = {key: node[key] for key in ("type", "description") if key in node}
    if "properties" in node:
        plain["properties"] = {name: _plain(one, parts) for name, one in node["properties"].items()}
    if "items" in node:
        plain["items"] = _plain(node["items"], parts)
    return plain
