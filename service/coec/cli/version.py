"""`coec --version`: the versions of this program and of what its decisions are computed with."""

from __future__ import annotations

import platform
from importlib import metadata

from coec import __version__

DECIDING = ("numpy", "numba", "llvmlite", "onnxruntime", "opencv-python-headless", "nlopt", "eclipse-zenoh")
"""Distributions whose other versions may round, draw or order differently. Where two machines decide differently, these
may differ."""


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
    """The versions in two lines."""
    of = document()
    own = of.pop("coec")
    return f"coec {own}\n" + ", ".join(f"{name} {version or 'not installed'}" for name, version in of.items())
