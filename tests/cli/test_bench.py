"""`coec bench` on a small scene: what it prints, and that its scene has its maximum at the truth."""

from __future__ import annotations

import numpy as np
import pytest

from cli.conftest import SMALL, Coec
from coec.calibration.objective import SearchBox
from coec.cli import bench, bench_scene
from coec.geometry import se3

PROMISED = {
    "mi_25_frames_ms", "ratio_to_numpy", "ratio_to_scalar", "solve_10deg_3dof_s", "solve_25deg_6dof_s", "machine",
}  # fmt: skip


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_scene, "POINTS", 4000)
    monkeypatch.setattr(bench, "FRAMES", 5)
    monkeypatch.setattr(bench, "FRAME_COUNTS", (5, 10))
    monkeypatch.setattr(bench, "REPEATS", 2)
    monkeypatch.setattr(bench, "FEW_REPEATS", 1)
    monkeypatch.setattr(bench, "STREET", SMALL)


@pytest.mark.slow
@pytest.mark.usefixtures("_small")
def test_the_document_holds_what_is_promised(coec: Coec) -> None:
    outcome = coec("bench", "--json")
    assert outcome.status == 0
    document = outcome.document
    assert set(document) >= PROMISED
    assert set(document["mi_25_frames_ms_by_model"]) == set(bench_scene.CAMERAS)
    assert set(document["mi_ms_by_frames"]) == {"5", "10"}
    assert all(document[name] > 0 for name in PROMISED - {"machine"})
    assert document["solve_10deg_3dof_error_deg"] < 0.3
    assert {"processor", "threads"} <= set(document["machine"])


@pytest.mark.parametrize("model", bench_scene.CAMERAS)
@pytest.mark.usefixtures("_small")
def test_the_scene_is_seen_best_from_the_truth(model: str) -> None:
    box = SearchBox(np.radians(10.0), 0.0)
    objective = bench_scene.objective_of(bench_scene.CAMERAS[model], 2, bench_scene.T_TRUE, box)
    truth = objective.evaluate(bench_scene.T_TRUE).score
    for axis in range(3):
        for degrees in (-3.0, 3.0):
            xi = np.zeros(6)
            xi[axis] = np.radians(degrees)
            assert objective.evaluate(se3.perturb(bench_scene.T_TRUE, xi)).score < truth
