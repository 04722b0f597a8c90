"""`coec run`: runs the daemon."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import ConfigFile, success_on_sigterm

if TYPE_CHECKING:
    from coec.config import Config

MATRIX_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Set to 1, because the service multiplies (N, 3) by (3, 3), where more threads only spin for longer than the work
takes. Read when NumPy is imported; the worker process gets its own."""


def run(
    config: ConfigFile,
    embedded_router: Annotated[
        bool, typer.Option("--embedded-router", help="Also be the Zenoh router, listening on `zenoh.listen`.")
    ] = False,
    state_dir: Annotated[
        Path | None, typer.Option(help="State directory, instead of `state.directory`.", metavar="DIR")
    ] = None,
) -> int:
    """Run the service until SIGTERM or SIGINT; SIGHUP reads the configuration again. Logs go to standard output."""
    with success_on_sigterm():
        from coec.config import load_config

        def read() -> Config:
            return _with_options(load_config(config), embedded_router, state_dir)

        loaded = read()
        for name in MATRIX_THREADS:
            os.environ.setdefault(name, "1")
        # Imported after the configuration is read, so that a mistake in it is reported at once.
        from coec import daemon
        from coec.io import system

        system.limit_arenas()
        system.reuse_frame_memory()
        return daemon.run(loaded, read)


def _with_options(config: Config, embedded_router: bool, state_dir: Path | None) -> Config:
    if embedded_router:
        config = config.model_copy(update={"zenoh": config.zenoh.model_copy(update={"embedded_router": True})})
    if state_dir is not None:
        config = config.model_copy(update={"state": config.state.model_copy(update={"directory": state_dir})})
    return config
