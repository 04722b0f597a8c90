"""A configuration as YAML with a comment on every key: for templates, and for people who check a configuration."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator
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


def _mapping(model: BaseModel, indent: str) -> Iterator[str]:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        remark = " ".join((field.description or "").split())
        if value is None:
            if remark:
                yield _line(f"{indent}# {name}:", remark)
        elif isinstance(value, BaseModel):
            yield from _heading(value, remark, indent)
            yield f"{indent}{name}:"
            yield from _mapping(value, indent + INDENT)
        elif _holds_models(value):
            if not indent:
                yield ""
            yield from _remark(remark, indent)
            yield f"{indent}{name}:"
            for item in value:
                first, *rest = _mapping(item, indent + INDENT * 2)
                yield f"{indent}{INDENT}- {first.lstrip()}"
                yield from rest
        elif _is_matrix(value):
            yield from _remark(remark, indent)
            yield f"{indent}{name}:"
            yield from (f"{indent}{INDENT}- {_scalar(row)}" for row in value)
        else:
            yield _line(f"{indent}{name}: {_scalar(value)}", remark)


def _heading(value: BaseModel, remark: str, indent: str) -> Iterator[str]:
    """A comment on what the block is for, with an empty line before it at the top level."""
    if not indent:
        yield ""
    text = remark or " ".join((type(value).__doc__ or "").split())
    yield from _remark(text, indent)


def _remark(text: str, indent: str) -> Iterator[str]:
    yield from textwrap.wrap(text, WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _line(text: str, remark: str) -> str:
    return f"{text:<{COMMENT_COLUMN}}  # {remark}" if remark else text


def _holds_models(value: object) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], BaseModel)


def _is_matrix(value: object) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], tuple)


def _scalar(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_scalar(item) for item in value) + "]"
    if isinstance(value, Path):
        value = str(value)
    if isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _RESERVED:
        return value
    # JSON is valid YAML: quoted strings, true and false, floats that read back to the same double. Only `1e+16` would
    # be text in YAML 1.1, and 1e16 does not occur.
    return json.dumps(value, ensure_ascii=False)
