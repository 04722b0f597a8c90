"""Simulated drives for tests: each is drawn once, and kept under pytest's cache until something it is made of changes.

A drive is made of every module that `coec_lab.simulation.drive` and `rig_drive` reach by their imports, and of
the libraries that draw it: their bytes and versions name the folder, so nobody has to remember to empty it.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import os
import pickle
import re
import shutil
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame, parse_spec
from coec_lab.simulation.source import open_sim
from conftest import REPOSITORY

F = TypeVar("F")

SERVICE = REPOSITORY / "service"
CACHE = REPOSITORY / ".pytest_cache" / "d" / "drives"
"""Where `pytest --cache-clear` clears."""

ROOTS = (
    *(SERVICE / "coec_lab" / "simulation" / name for name in ("drive.py", "rig_drive.py")),
    *(SERVICE / "coec" / "geometry" / "cameras").glob("*.py"),
)
"""What draws, and the lenses, which are imported by their names."""

PACKAGES = ("coec", "coec_lab")

LIBRARIES = ("embreex", "numba", "numpy", "opencv-python-headless")


def rendered_drive(query: dict[str, str], cameras: tuple[int, ...] | None = None) -> FramewiseRecording:
    """The recording that `coec_lab.simulation.source.open_sim` opens, its frames drawn once.

    Args:
        query: of a SOURCE `sim:...`.
        cameras: indices of the camera frames that are wanted, with what belongs to them; None = all.

    Raises:
        ValueError: pictures and sweeps do not come in pairs: such a drive has other uses than this.
    """
    return _rendered(tuple(sorted(query.items())), cameras)


def rendered_source(source: str, cameras: tuple[int, ...] | None = None) -> FramewiseRecording:
    """The recording of a SOURCE argument `sim:...`, as `drawn`."""
    return rendered_drive(parse_spec(source).query, cameras)


@functools.lru_cache(maxsize=8)
def _rendered(query: tuple[tuple[str, str], ...], cameras: tuple[int, ...] | None) -> FramewiseRecording:
    drive = open_sim(dict(query))
    messages = cached_messages((query, cameras), lambda: list(drive.messages(cameras)))
    pictures = [message for message in messages if isinstance(message, CameraFrame)]
    sweeps = [message for message in messages if isinstance(message, LidarFrame)]
    frames = tuple(
        RecordedFrame(picture.stamp_ns, partial(_same, picture), sweep.stamp_ns, partial(_same, sweep))
        for picture, sweep in zip(pictures, sweeps, strict=True)
    )
    motions = tuple(message for message in messages if isinstance(message, EgoMotion))
    return FramewiseRecording(drive.name, drive.rig, drive.T_camera_lidar_start, frames, motions)


def _same(frame: F) -> F:
    return frame


def cached_messages(identity: object, render: Callable[[], list[Frame]]) -> list[Frame]:
    """Messages that were drawn before and kept under what they are (by its `repr`), or that are drawn now. Processes
    that want the same wait for the one that draws it."""
    path = CACHE / _fingerprint() / f"{hashlib.sha256(repr(identity).encode()).hexdigest()[:16]}.pickle"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.is_file():
            cached: list[Frame] = pickle.loads(path.read_bytes())
            return cached
        messages = render()
        _store(path, messages)
    return messages


def _store(path: Path, messages: list[Frame]) -> None:
    for folder in CACHE.iterdir():
        if folder != path.parent:
            shutil.rmtree(folder, ignore_errors=True)  # the other half of the run may do the same
    part = path.with_suffix(f".{os.getpid()}")
    part.write_bytes(pickle.dumps(messages, protocol=pickle.HIGHEST_PROTOCOL))
    part.replace(path)


@functools.cache
def _fingerprint() -> str:
    """Of everything that a drive is made of."""
    digest = hashlib.sha256(sys.version.encode())
    for library in LIBRARIES:
        digest.update(f"{library} {version(library)}\n".encode())
    for path in sorted(modules_behind(*ROOTS)):
        digest.update(f"{path.relative_to(SERVICE)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


_IMPORT = re.compile(rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+)?import[ \t]+(\([^)]*\)|[^\n]*)", re.MULTILINE)
"""An import, with the module that names come from and the names: to parse every file takes seconds."""

_NAME = re.compile(rb"[\w.]+")


def modules_behind(*paths: Path) -> set[Path]:
    """The files of both packages that modules reach by their imports, wherever one stands; themselves among them."""
    reached: set[Path] = set()
    waiting = list(paths)
    while waiting:
        now = waiting.pop()
        if now in reached:
            continue
        reached.add(now)
        for module, names in _IMPORT.findall(now.read_bytes()):
            own = module.decode()
            for name in {own, *(f"{own}.{name.decode()}".lstrip(".") for name in _NAME.findall(names))}:
                chunks = name.split(".")
                if chunks[0] not in PACKAGES:
                    continue
                for depth in range(1, len(chunks) + 1):
                    location = SERVICE.joinpath(*chunks[:depth])
                    waiting += [
                        file for file in (location / "__init__.py", location.with_suffix(".py")) if file.is_file()
                    ]
    return reached
