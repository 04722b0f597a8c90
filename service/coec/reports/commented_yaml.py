"""A configuration as YAML: with every key and a comment on each, for templates and for people who check one, or with
nothing but what differs from the defaults, for people who edit one.

The text is written here because the YAML library (ruamel), which edits documents, sets no comments for keys without a
value, wraps none, and keeps no block on one line if it fits.
"""

import json
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import BaseModel

INDENT = "  "
COMMENT_COLUMN = 44
"""Column at which the comment behind a value begins, if the value leaves room."""

WIDTH = 120

_PLAIN = re.compile(r"[A-Za-z/.][A-Za-z0-9_./-]*")
_RESERVED = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


def commented_yaml(model: BaseModel) -> str:
    """Every field of the model with its value, followed by its description. Optional fields without a value appear as
    comments. `load_config` reads the text back to an equal model."""
    return "\n".join(_mapping(model, "")) + "\n"


def short_yaml(model: BaseModel, always: Collection[str], comments: Mapping[str, str]) -> str:
    """The fields of the model that differ from their defaults. `load_config` reads the text back to an equal model.

    A block is written on one line. One that does not fit has its nested blocks and matrices on lines of their own.

    Args:
        always: dotted names of fields that are written with their default, too; the entries of a list have no place in
            such a name.
        comments: comments by dotted name, on fields of the top level and of the entries of its lists.
    """
    lines: list[str] = []
    for name, value in _differing(model, "", always).items():
        if isinstance(value, list):
            lines.append(f"{name}:")
            for item in value:
                written = (_short_lines(key, below, name, comments) for key, below in item.items())
                first, *rest = chain.from_iterable(written)
                lines += [f"{INDENT}- {first}", *(f"{INDENT * 2}{line}" for line in rest)]
        else:
            lines += _short_lines(name, value, "", comments)
    return "\n".join(lines) + "\n"


def _differing(model: BaseModel, place: str, always: Collection[str]) -> dict[str, Any]:
    """Fields with a value that is not their default, and those of `always`; a list of models as a list of such
    mappings."""
    differing: dict[str, Any] = {}
    for name, field in type(model).model_fields.items():
        value, here = getattr(model, name), f"{place}{name}"
        if value is None:
            continue
        if isinstance(value, BaseModel):
            block = _differing(value, f"{here}.", always)
            if block or field.is_required():
                differing[name] = block
        elif here in always or field.is_required() or value != field.get_default(call_default_factory=True):
            if _holds_models(value):
                value = [_differing(item, f"{here}.", always) for item in value]
            differing[name] = value
    return differing


def _short_lines(name: str, value: Any, place: str, comments: Mapping[str, str]) -> Iterator[str]:
    comment = comments.get(f"{place}.{name}" if place else name, "")
    behind = f"  # {comment}" if comment else ""
    line = f"{name}: {_scalar(value)}"
    if len(line) <= WIDTH - 2 * len(INDENT) or not isinstance(value, dict | tuple):
        yield f"{line}{behind}"
    elif isinstance(value, dict):
        long = {key: below for key, below in value.items() if isinstance(below, dict) or _is_matrix(below)}
        first = [f"{key}: {_scalar(below)}" for key, below in value.items() if key not in long]
        parts = [", ".join(first), *(f"{key}: {_scalar(below)}" for key, below in long.items())]
        opened, *more = [f"{name}: {{{parts[0]}", *parts[1:]]
        *before, last = [opened, *(f"{INDENT}{part}" for part in more)]
        yield from (f"{each},{behind if index == 0 else ''}" for index, each in enumerate(before))
        yield f"{last}}}{'' if before else behind}"
    else:
        yield f"{name}:{behind}"
        yield from (f"{INDENT}- {_scalar(row)}" for row in value)


def _mapping(model: BaseModel, indent: str) -> Iterator[str]:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        comment = " ".join((field.description or "").split())
        if value is None:
            if comment:
                yield _line(f"{indent}# {name}:", comment)
        elif isinstance(value, BaseModel):
            yield from _heading(value, comment, indent)
            yield f"{indent}{name}:"
            yield from _mapping(value, indent + INDENT)
        elif _holds_models(value):
            if not indent:
                yield ""
            yield from _comment(comment, indent)
            yield f"{indent}{name}:"
            for item in value:
                first, *rest = _mapping(item, indent + INDENT * 2)
                yield f"{indent}{INDENT}- {first.lstrip()}"
                yield from rest
        elif _is_matrix(value):
            yield from _comment(comment, indent)
            yield f"{indent}{name}:"
            yield from (f"{indent}{INDENT}- {_scalar(row)}" for row in value)
        else:
            yield _line(f"{indent}{name}: {_scalar(value)}", comment)


def _heading(value: BaseModel, comment: str, indent: str) -> Iterator[str]:
    """A comment on what the block is for, with an empty line before it at the top level."""
    if not indent:
        yield ""
    text = comment or " ".join((type(value).__doc__ or "").split())
    yield from _comment(text, indent)


def _comment(text: str, indent: str) -> Iterator[str]:
    yield from textwrap.wrap(text, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _line(text: str, comment: str) -> str:
    return f"{text:<{COMMENT_COLUMN}}  # {comment}" if comment else text


def _holds_models(value: object) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], BaseModel)


def _is_matrix(value: object) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], tuple)


def _scalar(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_scalar(below)}" for key, below in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_scalar(item) for item in value) + "]"
    if isinstance(value, Path):
        value = str(value)
    if isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _RESERVED:
        return value
    # JSON is valid YAML: quoted strings, true and false, floats that read back to the same double. Only `1e+16` would
    # be text in YAML 1.1, and 1e16 does not occur.
    return json.dumps(value, ensure_ascii=False)
