"""The optional extra `fleet`: tables and what asks them."""

from __future__ import annotations

from typing import Any

from coec.errors import SourceError


def pyarrow() -> Any:
    """The library that writes tables.

    Raises:
        SourceError: it is not installed.
    """
    try:
        import pyarrow as module
    except ImportError as error:
        raise _missing() from error
    return module


def duckdb() -> Any:
    """The library that asks them.

    Raises:
        SourceError: it is not installed.
    """
    try:
        import duckdb as module
    except ImportError as error:
        raise _missing() from error
    return module


def _missing() -> SourceError:
    return SourceError("tables of many windows need the optional extra `fleet`: pip install 'coec[fleet]'")
