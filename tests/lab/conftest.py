"""The laboratory's commands in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import tomllib
from importlib import metadata

import pytest

from cli.conftest import Coec, coec, drawn_once  # noqa: F401  fixtures
from coec.cli.main import GROUP
from conftest import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "service" / "coec_lab" / "pyproject.toml").read_text())["project"]
POINTS = [metadata.EntryPoint(name, value, GROUP) for name, value in PROJECT["entry-points"][GROUP].items()]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line has the laboratory's commands, also where it is not installed."""
    monkeypatch.setattr(metadata, "entry_points", lambda **_: metadata.EntryPoints(POINTS))
