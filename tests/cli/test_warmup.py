"""`coec warmup`: which lenses it compiles for, where the kernels are, and when it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from coec.cli import warmup
from coec.config import Config
from coec.errors import OutputError, UsageError
from coec.geometry import compiler
from coec.geometry.cameras.registry import MODELS
from coec.reports.commented_yaml import commented_yaml
from coec.service.worker.compilation import compiled
from support.rigs import pair_config


def test_kernels_that_are_there_are_not_compiled_again(capsys: pytest.CaptureFixture[str]) -> None:
    def warmed() -> dict[str, Any]:
        assert warmup.warmup(lenses=["pinhole"], as_json=True) == 0
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        return document

    reported = warmed()
    if reported["files_written"]:
        reported = warmed()
    assert (reported["lenses"], reported["kernels"], reported["files_written"]) == (["pinhole"], compiled(1).total, 0)
    assert Path(reported["cache"]).is_dir()
    reached = compiled(1)
    assert reached.done == reached.total


def test_people_are_reported_where_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warmup, "_compile", lambda lenses: compiled(len(lenses)).total)
    assert warmup.warmup(lenses=["pinhole"]) == 0
    out = capsys.readouterr().out
    assert f"{compiled(1).total} kernels for pinhole" in out
    assert f"cached in {compiler.kernel_cache()[0]}" in out


@pytest.fixture
def requested(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The lenses of every compilation, of which none is done."""
    seen: list[list[str]] = []

    def compile_none(lenses: list[str]) -> int:
        Config.model_validate({"pairs": list(warmup._pairs(lenses))})
        seen.append(lenses)
        return 0

    monkeypatch.setattr(warmup, "_compile", compile_none)
    return seen


def test_by_default_it_compiles_for_every_lens_that_there_is(requested: list[list[str]]) -> None:
    warmup.warmup()
    assert requested == [list(MODELS)]


def test_it_compiles_for_the_lenses_of_a_configuration(tmp_path: Path, requested: list[list[str]]) -> None:
    path = tmp_path / "coec.yaml"
    pair = pair_config("front")
    path.write_text(commented_yaml(Config(pairs=(pair,))))
    warmup.warmup(config=path)
    path.write_text("middleware: rmw_zenoh\npairs: [{name: front, camera: /image, points: /points}]\n")
    warmup.warmup(config=path)
    assert pair.camera.intrinsics is not None
    assert requested == [[pair.camera.intrinsics.model], list(MODELS)], "a lens that CameraInfo tells may be any"


@pytest.mark.parametrize("options", [{"lenses": ["fish"]}, {"lenses": ["mei"], "config": Path("coec.yaml")}])
def test_it_refuses_an_unknown_lens_and_two_sources(options: dict[str, Any], requested: list[list[str]]) -> None:
    with pytest.raises(UsageError):
        warmup.warmup(**options)
    assert requested == []


@pytest.mark.fault("no folder for compiled kernels can be written", "`coec warmup` says so, and compiles nothing")
def test_without_a_cache_it_says_so(requested: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "kernel_cache", lambda: (Path("nowhere"), False))
    with pytest.raises(OutputError, match="XDG_CACHE_HOME"):
        warmup.warmup()
    assert requested == []
