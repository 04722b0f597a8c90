"""Makes a Typer command of a function that takes one dataclass; each field is declared once, as argument or option."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

import typer

OptionsT = TypeVar("OptionsT")


def taking(run: Callable[[OptionsT], int]) -> Callable[..., None]:
    """The function that Typer reads and calls for `run(options)`. It takes the fields of the dataclass that annotates
    `options`, has the help text of `run`, and exits with the status that `run` returns."""
    options = get_type_hints(run)["options"]

    def command(**given: Any) -> None:
        raise typer.Exit(run(options(**given)))

    command.__doc__ = run.__doc__
    command.__signature__ = inspect.signature(options, eval_str=True)  # type: ignore[attr-defined]
    return command
