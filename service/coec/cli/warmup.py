"""`coec warmup`: compiles the kernels of the service into the cache of the user."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coec.cli.options import Json
from coec.errors import OutputError, UsageError
from coec.reports import console
from coec.reports.console import StageTimes

if TYPE_CHECKING:
    pass

SIZE = {"width": 160, "height": 120, "fx": 60.0, "fy": 60.0, "cx": 79.5, "cy": 59.5}
"""Kernels are compiled for types, not for sizes."""

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def warmup(
    config: Annotated[
        Path | None,
        typer.Option(
            help="Compile for the lenses in this configuration of the daemon (YAML); default: for every lens model.",
            metavar="FILE",
            show_default=False,
        ),
    ] = None,
    lenses: Annotated[
        list[str] | None,
        typer.Option(
            "--lens",
            help="Compile for this lens model, such as pinhole; repeatable.",
            metavar="MODEL",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Compile the kernels that the service and the calibration use, so that no first start has to.

    They are cached for the user who runs the command and for processors like this one. Cached kernels are not compiled
    again.
    """
    from coec.geometry.compiler import kernel_cache

    models = _lens_models(config, lenses)
    folder, is_writable = kernel_cache()
    if not is_writable:
        text = "set XDG_CACHE_HOME or NUMBA_CACHE_DIR to one that belongs to this user"
        raise OutputError(f"no folder for compiled kernels can be written: {text}")
    before, started_s = _files(folder), time.monotonic()
    total = _compile(models)
    fresh, took_s = len(_files(folder) - before), time.monotonic() - started_s
    if as_json:
        document = {"cache": str(folder), "lenses": models, "kernels": total, "files_written": fresh, "seconds": took_s}
        console.print_json(document)
    else:
        done = "nothing had to be compiled" if not fresh else f"compiled in {took_s:.0f} s"
        console.show(f"{total} kernels for {', '.join(models)}: {done}")
        console.show(f"cached in {folder}")
    return 0


def _lens_models(config: Path | None, lenses: Sequence[str] | None) -> list[str]:
    """The lens models to compile for, in the order of the registry."""
    from coec.config import load_config
    from coec.geometry.cameras.registry import MODELS

    if config is not None and lenses:
        raise UsageError("give either --config or --lens")
    named = set(lenses or MODELS)
    if unknown := sorted(named - set(MODELS)):
        raise UsageError(f"--lens {unknown[0]}: unknown; known are {', '.join(MODELS)}")
    if config is not None:
        lenses_of_pairs = (pair.camera.intrinsics for pair in load_config(config).every_pair)
        models = {None if lens is None else lens.model for lens in lenses_of_pairs}  # None: of a `CameraInfo` to come
        named = set(MODELS) if None in models else {lens for lens in models if lens is not None}
    return [lens for lens in MODELS if lens in named]


def _compile(lenses: Sequence[str]) -> int:
    """Runs every kernel once; returns how many there are."""
    from coec.config import Config
    from coec.geometry import compilation_events
    from coec.service.worker.compilation import compiled
    from coec.service.worker.tasks import Solver
    from coec.service.worker.warm_up import second_compiler

    config = Config.model_validate({"pairs": list(_pairs(lenses))})
    total = compiled(len(lenses)).total
    with console.progress(compiling=False) as bars:
        times = StageTimes(bars)

        def report(_: str) -> None:
            times.step("compiling kernels", compiled(len(lenses)).done, total)

        with compilation_events.listening(report), second_compiler(config):
            Solver(config, 1).warm_up()
    return total


def _pairs(lenses: Sequence[str]) -> Iterable[dict[str, Any]]:
    """A pair for each lens, on LiDARs of two kinds: with and without times of its points."""
    from coec.geometry.cameras.registry import MODELS

    for lens in lenses:
        parameters = dict.fromkeys(MODELS[lens].parameters, 0.0) | SIZE
        if "alpha" in parameters:
            parameters["alpha"] = 0.5
        if "beta" in parameters:
            parameters["beta"] = 1.0
        kinds: dict[str, dict[str, Any]] = {"timed": {}, "spinning": {"sweep": {}}}
        for kind, given in kinds.items():
            yield {
                "name": f"{lens}-{kind}",
                "camera": {"key": f"{lens}/camera", "intrinsics": {"model": lens, **parameters}},
                "lidar": {"key": f"{lens}/{kind}", **given},
                "ego": {"key": "ego"},
                "T_camera_lidar": IDENTITY,
                "calibration": {"depth": {"model": "stereo"}, "search": {"dof": 6}},
            }


def _files(folder: Path) -> set[Path]:
    """The compiled kernels in a folder."""
    return set(folder.rglob("*.nbc"))
