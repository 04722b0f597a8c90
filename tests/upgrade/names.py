"""Modules and definitions by the names that they have, or had, in the version of coec on PYTHONPATH."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def maybe(*places: str) -> Any:
    """What stands at the first of the places, `module` or `module:name`, that this version has; None if at none."""
    for place in places:
        module, _, name = place.partition(":")
        try:
            result = import_module(module)
        except ModuleNotFoundError:
            continue
        if not name:
            return result
        if hasattr(result, name):
            return getattr(result, name)
    return None


def first_of(*places: str) -> Any:
    """Likewise, of something that every version has."""
    result = maybe(*places)
    if result is None:
        raise ImportError(f"this version has none of {', '.join(places)}")
    return result
