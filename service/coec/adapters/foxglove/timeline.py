"""What the timeline of a viewer tells, as JSON with a schema that viewers read: plain types, nothing that may be null
(what is not known is left out), every field named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

NOT_SERVED = "not_served"
"""Nobody serves the pair: its liveliness token is not there."""

SILENT = "silent"
"""Somebody serves it, and does not answer."""

RECORDED = "recorded"
"""No service: a recording is played."""


class _Told(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Axes(_Told):
    """Rotation vector about, and translation along, the axes of the camera; what is not known is left out."""

    rx_deg: float | None = None
    ry_deg: float | None = None
    rz_deg: float | None = None
    tx_m: float | None = None
    ty_m: float | None = None
    tz_m: float | None = None


class Ages(_Told):
    """Seconds since something last came; left out where nothing has, or where nobody listens to it."""

    camera_s: float | None = None
    lidar_s: float | None = None
    ego_s: float | None = None
    answer_s: float | None = Field(default=None, description="of the service, to a question or by itself")


class Figure(_Told):
    """Of the self-diagnosis, beside its limit."""

    name: str
    value: float | None
    limit: float | None
    passed: bool


class Missed(_Told):
    """Frames that came here and were not shown."""

    stream: str
    cause: str
    count: int


class Moment(_Told):
    """A line of the timeline."""

    pair: str
    state: str = Field(description="of the service's health; or not_served, silent, recorded")
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    why: str = Field(description="sentences of the reasons")
    reasons: tuple[str, ...] = Field(default=(), description="their codes")
    needs: tuple[str, ...] = Field(default=(), description="what is still missing")
    provenance: str | None = Field(default=None, description="of the extrinsic that is served")
    status: str | None = Field(default=None, description="of the latest attempt; of a recording, of its result")
    percent_complete: float | None = Field(default=None, description="of the open window")
    candidate: bool = Field(default=False, description="whether one is shown")
    ages: Ages = Ages()
    pair_rate_hz: float | None = None
    sync_error_s: float | None = None
    correction: Axes = Field(default=Axes(), description="of what is served, from nominal")
    sigma: Axes = Field(default=Axes(), description="its standard deviations")
    step: Axes = Field(default=Axes(), description="of the candidate, from what is served")
    figures: tuple[Figure, ...] = ()
    not_shown: tuple[Missed, ...] = ()

    def document(self) -> dict[str, Any]:
        """As it is sent."""
        return self.model_dump(mode="json", exclude_none=True)


def schema() -> dict[str, Any]:
    """JSON Schema of a `Moment`, without references and choices: viewers follow none."""
    whole = Moment.model_json_schema()
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
