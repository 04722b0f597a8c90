"""The laboratory's commands in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import tomllib
from importlib import metadata

import pytest

from cli.conftest import Coec, coec, drawn_once  # noqa: F401  fixtures
from conftest import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "service" / "coec_lab" / "pyproject.toml").read_text())["project"]
POINTS = metadata.EntryPoints(
    metadata.EntryPoint(name, value, group)
    for group, points in PROJECT["entry-points"].items()
    for name, value in points.items()
)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line has the laboratory's commands, also where it is not installed."""
    monkeypatch.setattr(metadata, "entry_points", POINTS.select)
