"""Generated inputs: Hypothesis strategies that prefer the places where formulas break (zero, the axis, right angles,
half turns) and where readers do (the ends of types, one type where another is expected), and text that a terminal
would obey, in every field of a message that can hold text.
"""

from __future__ import annotations

import enum
import math
import re
import types
import unicodedata
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np
from annotated_types import Ge, Gt, Le, MaxLen
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import BaseModel

_SINGULAR_RAD = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4, math.pi)
_OFFSETS_RAD = (0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.03)


def _near_singular_angles() -> st.SearchStrategy[float]:
    return st.builds(
        lambda centre, offset, sign: min(max(centre + sign * offset, 0.0), math.pi),
        st.sampled_from(_SINGULAR_RAD),
        st.sampled_from(_OFFSETS_RAD),
        st.sampled_from((-1.0, 1.0)),
    )


def angles_rad() -> st.SearchStrategy[float]:
    """Angles in [0, pi], half of them within 0.03 rad of a multiple of 45 degrees, many much closer."""
    return _near_singular_angles() | st.floats(0.0, math.pi)


def directions() -> st.SearchStrategy[NDArray[np.float64]]:
    """Unit vectors (3,) by polar angle from +z and azimuth."""
    return st.builds(
        lambda polar, azimuth: np.array(
            [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
        ),
        angles_rad(),
        angles_rad() | angles_rad().map(lambda angle: -angle),
    )


def points_m() -> st.SearchStrategy[NDArray[np.float64]]:
    """Points (3,) of the camera frame, a millimetre to ten kilometres away, in any direction."""
    return st.builds(lambda direction, exponent: direction * 10.0**exponent, directions(), st.floats(-3.0, 4.0))


def rotation_vectors() -> st.SearchStrategy[NDArray[np.float64]]:
    """Rotation vectors (3,), radians, of length 0 to pi."""
    return st.builds(lambda axis, angle: axis * angle, directions(), angles_rad())


def twists() -> st.SearchStrategy[NDArray[np.float64]]:
    """xi (6,): a rotation vector as above and a translation of up to 100 m."""
    return st.builds(
        lambda r, direction, length: np.concatenate([r, direction * length]),
        rotation_vectors(),
        directions(),
        st.sampled_from((0.0, 1e-9, 0.5)) | st.floats(0.0, 100.0),
    )


def scalars() -> st.SearchStrategy[Any]:
    """What a document may hold at its ends, in every encoding."""
    texts = st.sampled_from(("", "\0", "/", "..", "1e999", "front", "accepted"))
    return st.one_of(
        st.none(),
        st.booleans(),
        st.sampled_from((0, -1, 2**31, 2**53, 2**63 - 1, -(2**63))),
        st.sampled_from((0.0, -0.0, 1e308, 5e-324, 0.5)) | st.floats(allow_nan=False, allow_infinity=False),
        texts | st.text(st.characters(codec="utf-8"), max_size=8),
    )


def documents(names: Sequence[str]) -> st.SearchStrategy[Any]:
    """Maps and lists in one another that every encoding can write, with these names for most of their fields."""
    fields = st.sampled_from(tuple(names)) | st.text(st.characters(codec="utf-8"), max_size=4)
    rows = st.just([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return st.recursive(
        scalars() | rows,
        lambda inner: st.lists(inner, max_size=6) | st.dictionaries(fields, inner, max_size=6),
        max_leaves=20,
    )


M = TypeVar("M", bound=BaseModel)

HOSTILE = (
    "\x1b[35;45m\x9b2J\x1b]52;c;aGk=\x07\r\b\t\x7f\x85\u2028\u202e\u2066\u200f\u200b\ufeff\U000e0041\ufe0f"
    "\nx[red]&<i a='\">"
)
"""Colours, an erased screen, the clipboard, a line that overwrites another, text in the other direction, characters
without a shape, a second line, markup of rich and of HTML."""

HOSTILE_SHORT = "\x1b[35;45m\x9b\r\u202e\n"
"""The worst of it, for fields of a few characters."""

OBEYED_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Co", "Zl", "Zp"})
"""Categories of characters that a terminal obeys or does not show."""

RICH_SEQUENCES = re.compile(r"\x1b\[[0-9;]*m|\x1b\[\?25[hl]|\x1b\[\?1049[hl]|\x1b\[[0-9;]*[AHJK]|\x1b\[2K|\r")
"""What rich sends to a terminal by itself: styles, and the moves of a live display."""


def obeyed_characters(text: str, *, styled: bool = False) -> str:
    """The characters of an output that a terminal would obey, apart from line breaks and, if `styled`, what rich makes;
    empty for a harmless output."""
    assert "\x1b[35;45m" not in text, "colours of the text itself"
    assert "\ufe0f" not in text
    rest = RICH_SEQUENCES.sub("", text) if styled else text
    return "".join(sign for sign in rest if sign != "\n" and unicodedata.category(sign) in OBEYED_CATEGORIES)


def hostile_message(model: type[M], choice: int = 0, text: str = HOSTILE, **known: Any) -> M:
    """A message in which every text, and every name in a map, is `text`; optional fields are there. `choice` selects
    among fixed words, and of yes and no. `known` are fields whose values are not chosen here."""
    given = {
        name: known[name] if name in known else _value(field.annotation, tuple(field.metadata), choice, text)
        for name, field in model.model_fields.items()
    }
    return model.model_validate(given)


def message_texts(value: object) -> list[str]:
    """Every text in a message."""
    if isinstance(value, BaseModel):
        value = [getattr(value, name) for name in type(value).model_fields if not _is_fixed(type(value), name)]
    if isinstance(value, dict):
        return [text for item in (*value.keys(), *value.values()) for text in message_texts(item)]
    if isinstance(value, list | tuple):
        return [text for item in value for text in message_texts(item)]
    return [value] if isinstance(value, str) and not isinstance(value, enum.Enum) else []


def _is_fixed(model: type[BaseModel], name: str) -> bool:
    """Whether a field holds only words of a fixed set."""
    return "Literal" in str(model.model_fields[name].annotation)


def _value(kind: Any, limits: tuple[Any, ...], choice: int, text: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _value(inner[0], (*limits, *_flat(inner[1:])), choice, text)
    if origin is Literal:
        return inner[-choice]
    if origin in (Union, types.UnionType):
        return _value(next(one for one in inner if one is not type(None)), limits, choice, text)
    if origin is tuple:
        several = (inner[0],) if inner[-1] is Ellipsis else inner
        return tuple(_value(one, (), choice, text) for one in several)
    if origin is dict:
        return {_value(inner[0], (), choice, text): _value(inner[1], (), choice, text)}
    if issubclass(kind, BaseModel):
        return {
            name: _value(field.annotation, tuple(field.metadata), choice, text)
            for name, field in kind.model_fields.items()
        }
    if issubclass(kind, enum.Enum):
        return list(kind)[-choice]
    if issubclass(kind, bool):
        return choice == 0
    if issubclass(kind, str):
        longest = min((limit.max_length for limit in limits if isinstance(limit, MaxLen)), default=len(text))
        return (text if longest >= len(text) else HOSTILE_SHORT)[:longest]
    least = max((_number(limit) for limit in limits if isinstance(limit, Ge | Gt)), default=0)
    most = min((_number(limit) for limit in limits if isinstance(limit, Le)), default=least + 1)
    return kind(min(least + 1, most))


def _flat(annotations: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(limit for one in annotations for limit in getattr(one, "metadata", (one,)))


def _number(limit: Any) -> float:
    return float(getattr(limit, "ge", getattr(limit, "gt", getattr(limit, "le", 0))))
