"""The laboratory's commands in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator
from importlib import metadata

import pytest

from cli.conftest import Coec, coec, rendered_once  # noqa: F401  fixtures
from coec_lab.simulation import surroundings
from coec_lab.simulation.passages import Passages
from coec_lab.simulation.road import Road
from coec_lab.simulation.street import Stretch, Style, build_stretch
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


Streets = dict[tuple[object, ...], Stretch]
"""Stretches of streets that were built, by all that they are built of."""


@pytest.fixture(scope="module")
def streets() -> Iterator[Streets]:
    """Drives of one street share its stretches. To build them takes most of the time of a short drive; `test_scene.py`
    holds that a stretch depends on nothing else."""
    built: Streets = {}

    def built_once(seed: int, index: int, road: Road, style: Style, passages: Passages) -> Stretch:
        key = (seed, index, road.begin_m, hashlib.sha256(road.table.tobytes()).digest(), passages)
        if key not in built:
            built[key] = build_stretch(seed, index, road, style, passages)
        return built[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surroundings, "build_stretch", built_once)
        yield built
