"""The optional extra `fleet`: the libraries for tables and for queries of them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from coec.errors import SourceError


def optional_library(name: str) -> Any:
    """A module of the extra.

    Raises:
        SourceError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise SourceError(
            "tables of many windows need the optional extra `fleet`: pip install 'coec[fleet]'"
        ) from error
