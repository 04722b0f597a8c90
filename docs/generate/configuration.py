"""The page on the configuration, from the models that read it: every key once."""

from __future__ import annotations

import re
from collections.abc import Iterator
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from coec.config import Config
from coec.config.pair import OpenCameraConfig, OpenEgoConfig, OpenLidarConfig, OpenPairConfig, PairConfig
from coec.config.rig import RigConfig, RigStages
from generate.markdown import WRITTEN, code, prose, table

HEAD = """\
# Configuration

{written}
One YAML file. `coec check-config --defaults` prints a template in which every key stands with its default,
`coec check-config FILE` what a file comes to, and why it cannot be used (exit 78). Unknown keys are refused. Relative
paths are relative to the file. What a running service takes without a restart is told in
[operations](operations.md#reload). Times without another unit in their name are seconds of the sensors.

A range is an interval: `[` and `]` belong to it, `(` and `)` do not. *needed* stands where there is no default.

{sections}"""

RIG = """\
## The sensors of a vehicle, each told once

The other form of the same file, with `cameras` and `lidars`: the pairs follow from the sensors ([a rig](rig.md)). A
camera, a LiDAR and the ego-motion take every key of `pairs[].camera`, `pairs[].lidar` and `pairs[].ego` above, except
where a table says otherwise; `stages` and each entry of `pairs` take `pairing`, `window`, `calibration`, `monitor`,
`policy` and `tracker` as they stand above. All that is no sensor and no pair stays as it is.

"""

UNITS = (
    (r"_deg_per_sqrt_h$", "°/√h"),
    (r"_m_per_sqrt_h$", "m/√h"),
    (r"_per_deg2$", "1/°²"),
    (r"_deg_per_s$", "°/s"),
    (r"_bytes_per_s$", "B/s"),
    (r"_per_day_deg$|_deg$", "°"),
    (r"_per_day_m$|_m$", "m"),
    (r"_mps$", "m/s"),
    (r"_mib$", "MiB"),
    (r"_bytes$", "B"),
    (r"_days$", "d"),
    (r"^hours_", "h"),
    (r"_s$", "s"),
    (r"_pixels$|^width$|^height$|^[fc][xy]$", "px"),
    (r"^T_", "m"),
)
"""Unit of a key by how its name ends; the first pattern that matches counts."""


def configuration_page() -> str:
    """Markdown: every key with its default, unit, range and what it means."""
    sections = [_section(place, model, rows) for place, model, rows in _parts(Config, "")]
    rig = [_section(place, model, rows) for place, model, rows in _parts(RigConfig, "", of_rig=True)]
    return HEAD.format(written=WRITTEN, sections="\n".join(sections) + "\n" + RIG + "\n".join(rig))


def _parts(
    model: type[BaseModel], place: str, *, of_rig: bool = False
) -> Iterator[tuple[str, type[BaseModel], list[tuple[str, FieldInfo]]]]:
    """Each model of the configuration with its place and its own keys, the whole before its parts.

    What is described elsewhere is left out: all of `awaited`, because its entries are those of `pairs`, and the keys
    that a rig's sensors share with those of a pair.
    """
    known: set[str] = set().union(*(base.model_fields for base in _SHARED if of_rig and issubclass(model, base)))
    changed = {name for name in known if model.model_fields[name].annotation is not _annotation(model, name)}
    own = [(name, field) for name, field in model.model_fields.items() if name not in known or name in changed]
    if place == "" and of_rig:
        own = [(name, field) for name, field in own if name != "links"]
    yield place, model, [(place + name, field) for name, field in own]
    for name, field in own:
        child, many = _model_of(field.annotation)
        if child is None or child is OpenPairConfig or (of_rig and child is RigStages):
            continue
        yield from _parts(child, f"{place}{name}{'[]' if many else ''}.", of_rig=of_rig)


_SHARED = (OpenCameraConfig, OpenLidarConfig, OpenEgoConfig, RigStages)


def _annotation(model: type[BaseModel], name: str) -> Any:
    """The annotation of a field in the model from which this model inherits it."""
    base = next(base for base in _SHARED if issubclass(model, base))
    return base.model_fields[name].annotation


def _section(place: str, model: type[BaseModel], rows: list[tuple[str, FieldInfo]]) -> str:
    title = code(place.rstrip(".")) if place else ("At the top of the file" if model is Config else "Sensors and pairs")
    heads = ("key", "default", "unit", "range", "what it means")
    body = table(heads, [_row(name, field) for name, field in rows])
    level = "##" if place.count(".") < 2 and model is not PairConfig else "###"
    return f"{level} {title}\n\n{prose(model.__doc__ or '')}\n\n{body}"


def _row(place: str, field: FieldInfo) -> tuple[str, str, str, str, str]:
    name = place.rpartition(".")[2]
    child, many = _model_of(field.annotation)
    if child is not None:
        what = field.description or f"{(child.__doc__ or '').partition('.')[0]}"
        default = "*needed*" if field.is_required() else ("" if field.default not in (None, ()) else "*none*")
        return f"`{place}`", default, "", "a list" if many else "a block", prose(what)
    return f"`{place}`", _default(field), _unit(name), _range(field), prose(field.description or "")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "*needed*"
    value = field.default
    if value is PydanticUndefined or value is None:
        return "*none*"
    if isinstance(value, tuple) and value and isinstance(value[0], tuple):
        return "identity"
    if isinstance(value, tuple):
        return ", ".join(code(item) for item in value) or "*none*"
    return code(str(value).lower() if isinstance(value, bool) else value if value != "" else '""')


def _unit(name: str) -> str:
    return next((unit for pattern, unit in UNITS if re.search(pattern, name)), "")


def _range(field: FieldInfo) -> str:
    choices = [choice for one in _flat(field.annotation) if get_origin(one) is Literal for choice in get_args(one)]
    if choices:
        return ", ".join(code(choice) for choice in choices)
    if field.annotation is bool:
        return "`true`, `false`"
    low = high = ""
    for bound in field.metadata:
        if isinstance(bound, annotated_types.Interval):
            continue
        for kind, mark in (("ge", "["), ("gt", "(")):
            low = f"{mark}{getattr(bound, kind):g}" if getattr(bound, kind, None) is not None else low
        for kind, mark in (("le", "]"), ("lt", ")")):
            high = f"{getattr(bound, kind):g}{mark}" if getattr(bound, kind, None) is not None else high
    return f"{low or '(−∞'}, {high or '∞)'}" if low or high else ""


def _flat(annotation: Any) -> Iterator[Any]:
    """The annotation, and recursively the members of unions and tuples in it."""
    yield annotation
    if get_origin(annotation) in (Union, UnionType, tuple):
        for part in get_args(annotation):
            yield from _flat(part)


def _model_of(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The model that a field holds, if any, and whether it holds several."""
    for part in _flat(annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            many = any(get_origin(one) is tuple for one in _flat(annotation))
            return part, many
    return None, False
