"""`coec --version`: this program, and what its decisions are computed with."""

from __future__ import annotations

import platform
from importlib import metadata

from coec import __version__

DECIDING = ("numpy", "numba", "llvmlite", "onnxruntime", "opencv-python-headless", "nlopt", "eclipse-zenoh")
"""Distributions of which another version may round, draw or order otherwise: what differs from machine to machine where
a decision does."""


def document() -> dict[str, str | None]:
    """Versions by name; None: not installed."""
    found: dict[str, str | None] = {"coec": __version__, "python": platform.python_version()}
    for name in DECIDING:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return {**found, "machine": platform.machine(), "system": platform.platform(terse=True)}


def text() -> str:
    """The same in two lines."""
    of = document()
    own = of.pop("coec")
    return f"coec {own}\n" + ", ".join(f"{name} {version or 'not installed'}" for name, version in of.items())
