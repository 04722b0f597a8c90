"""The laboratory's commands in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator
from importlib import metadata

import numpy as np
import pytest
import xxhash

from cli.conftest import Coec, coec, rendered_once  # noqa: F401  fixtures
from coec_lab.simulation import scene, surroundings
from coec_lab.simulation.mesh import Mesh
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

INDEXED = 12
"""Meshes whose index is retained, those used last: a street and its cars are six."""


@pytest.fixture(scope="module")
def streets() -> Iterator[Streets]:
    """Drives of one street share its stretches, and what Embree has indexed. To build these takes most of the time of
    a short drive; `test_scene.py` holds that a stretch depends on nothing else."""
    built: Streets = {}
    indexed: dict[str, scene.Solid] = {}
    index_mesh = scene.Solid

    def built_once(seed: int, index: int, road: Road, style: Style, passages: Passages) -> Stretch:
        key = (seed, index, road.begin_m, hashlib.sha256(road.table.tobytes()).digest(), passages)
        if key not in built:
            built[key] = build_stretch(seed, index, road, style, passages)
        return built[key]

    def indexed_once(mesh: Mesh) -> scene.Solid:
        digest = xxhash.xxh3_128()
        for array in (mesh.corners_m, mesh.colour, mesh.material):
            digest.update(np.ascontiguousarray(array).data)
        key = digest.hexdigest()
        indexed[key] = indexed.pop(key) if key in indexed else index_mesh(mesh)
        while len(indexed) > INDEXED:
            del indexed[next(iter(indexed))]
        return indexed[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surroundings, "build_stretch", built_once)
        patch.setattr(scene, "Solid", indexed_once)
        yield built
