"""The laboratory's commands in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from functools import wraps
from importlib import import_module

import pytest
import typer

from cli.conftest import Coec, coec, drawn_once  # noqa: F401  fixtures
from coec import cli
from conftest import REPOSITORY

PROJECT = REPOSITORY / "service" / "coec_lab" / "pyproject.toml"
ENTRY_POINTS: dict[str, str] = tomllib.loads(PROJECT.read_text())["project"]["entry-points"]["coec.commands"]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line has the laboratory's commands, also where it is not installed."""
    of_coec = cli.application

    def application(words: Sequence[str]) -> typer.Typer:
        name = ".".join(words[:2]) if ".".join(words[:2]) in ENTRY_POINTS else "".join(words[:1])
        if name not in ENTRY_POINTS:
            return of_coec(words)
        app = of_coec(["check-config"])
        group, _, leaf = name.rpartition(".")
        module, _, attribute = ENTRY_POINTS[name].partition(":")
        command = getattr(import_module(module), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        elif group:
            below = typer.Typer()
            below.callback()(lambda: None)
            below.command(leaf)(_exiting(command))
            app.add_typer(below, name=group)
        else:
            app.command(name)(_exiting(command))
        return app

    monkeypatch.setattr(cli, "application", application)


def _exiting(command: Callable[..., int]) -> Callable[..., None]:
    @wraps(command)
    def run(**options: object) -> None:
        raise typer.Exit(command(**options))

    return run
