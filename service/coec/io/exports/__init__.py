"""Writes an extrinsic into files of other programs: every module here is a format, under the name of its file.

A module has `text`, the function of `Format`, and `ENCODING`. In a file that can hold several transforms, only this one
is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from coec.io.exported_extrinsic import ExportedExtrinsic

NAMES = tuple(sorted(module.name for module in iter_modules(__path__)))
"""The formats, as a user writes them. They are known before any is imported, for help texts."""


class Format(NamedTuple):
    """How a file is written.

    Attributes:
        text: returns the new content of the file, given its present content (None: there is no file yet). Raises
            `OutputError` if that is not possible.
        encoding: of the text, as Zenoh names encodings.
    """

    text: Callable[[ExportedExtrinsic, str | None], str]
    encoding: str


@cache
def formats() -> Mapping[str, Format]:
    """All formats by name."""
    modules = {name: import_module(f"{__name__}.{name}") for name in NAMES}
    return MappingProxyType({name: Format(module.text, module.ENCODING) for name, module in modules.items()})
