"""How golden values are stored and compared.

Beside every hash stands what it is a hash of, rounded. Hashes are compared where decisions are computed with the same
libraries on the same kind of processor; values are compared everywhere, within a tolerance.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from importlib import metadata
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
from pydantic import BaseModel

DATA = Path(__file__).with_name("data")
IDENTITY = DATA / "identity.json"

LIBRARIES = ("numpy", "numba", "llvmlite", "onnxruntime", "opencv-python-headless", "nlopt")
"""Another version of these may round, draw or order differently."""

SETTINGS = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE")
"""Environment variables by which libraries compute for another processor than this one."""

VECTORS = ("sse", "avx", "fma", "f16c", "neon", "sve", "asimd")
RELATIVE, ABSOLUTE = 1e-3, 1e-5
MOST_COUNTED = 10**9


@functools.cache
def identity() -> dict[str, Any]:
    """What decisions are computed with, as far as their last digits depend on it."""
    features = llvmlite.binding.get_host_cpu_features()
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: metadata.version(name) for name in LIBRARIES},
        "machine": platform.machine(),
        "processor": str(llvmlite.binding.get_host_cpu_name()),
        "vectors": " ".join(sorted(name for name, on in features.items() if on and name.startswith(VECTORS))),
        "settings": {name: os.environ[name] for name in SETTINGS if name in os.environ},
    }


def is_identical() -> bool:
    """Whether decisions are computed here with what the golden ones were computed with."""
    return bool(read(IDENTITY) == identity())


def sha256(data: bytes) -> str:
    """Of bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def canonical(value: Any) -> bytes:
    """JSON with every digit."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":")).encode()


def plain(value: Any) -> Any:
    """Of numbers, texts, lists and tables alone. Data classes are lists of their values: the names of their fields are
    nobody's business. Models keep their names, which are those on the wire."""
    match value:
        case BaseModel():
            return value.model_dump(mode="json")
        case Enum():
            return plain(value.value)
        case bytes():
            return sha256(value)
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case dict():
            return {str(plain(key)): plain(one) for key, one in value.items()}
        case tuple() | list():
            return [plain(one) for one in value]
        case float() if not math.isfinite(value):
            return str(value)
        case None | bool() | int() | float() | str():
            return value
    assert is_dataclass(value), type(value)
    return [plain(getattr(value, one.name)) for one in fields(value)]


def rounded(value: Any, digits: int = 6) -> Any:
    """Every real number with so many significant digits; texts of sentences are left out."""
    match value:
        case dict():
            return {key: rounded(one, digits) for key, one in value.items() if key != "text"}
        case list():
            return [rounded(one, digits) for one in value]
        case float():
            short = float(f"{value:.{digits}g}")
            return 0.0 if abs(short) < 1e-9 else short
    return value


@dataclass(frozen=True)
class Tolerance:
    """By how much two numbers may differ; `counts`: the share by which whole numbers may, that are no stamps."""

    relative: float = RELATIVE
    absolute: float = ABSOLUTE
    counts: float = 0.0

    def accepts(self, a: float, b: float) -> bool:
        if isinstance(a, int) and isinstance(b, int):
            return a == b or (max(abs(a), abs(b)) < MOST_COUNTED and math.isclose(a, b, rel_tol=self.counts))
        return math.isclose(a, b, rel_tol=self.relative, abs_tol=self.absolute)


def differences(golden: Any, now: Any, tolerance: Tolerance, where: str = "") -> list[str]:
    """Every place at which values differ by more than is allowed; texts must be equal."""
    if isinstance(golden, dict) and isinstance(now, dict):
        names = sorted(golden.keys() | now.keys())
        return [
            line
            for name in names
            for line in differences(golden.get(name), now.get(name), tolerance, f"{where}.{name}" if where else name)
        ]
    if isinstance(golden, list) and isinstance(now, list) and len(golden) == len(now):
        pairs = enumerate(zip(golden, now, strict=True))
        return [line for k, (a, b) in pairs for line in differences(a, b, tolerance, f"{where}[{k}]")]
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (golden, now))
    if numbers and tolerance.accepts(golden, now):
        return []
    return [] if golden == now and type(golden) is type(now) else [f"{where}: was {golden!r}, is {now!r}"]


def read(path: Path) -> Any:
    """A document of golden values."""
    return json.loads(path.read_text(encoding="utf-8"))


def write(path: Path, document: dict[str, Any]) -> None:
    """One line for each entry."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{json.dumps(key)}: {json.dumps(document[key], sort_keys=True)}" for key in sorted(document)]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def write_lines(path: Path, lines: Sequence[Any]) -> None:
    """JSON lines: the hash of all of them with every digit, then each of them rounded."""
    path.parent.mkdir(parents=True, exist_ok=True)
    documents = [{"sha256": sha256(canonical(list(lines)))}, *(rounded(plain(line)) for line in lines)]
    path.write_text("".join(json.dumps(line, sort_keys=True) + "\n" for line in documents), encoding="utf-8")


def check_lines(path: Path, lines: Sequence[Any], tolerance: Tolerance) -> None:
    """Compares a stream with the golden one."""
    head, *golden = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    now = json.loads(json.dumps([rounded(plain(line)) for line in lines]))
    result = [f"{len(golden)} lines were written, now {len(now)}"] if len(golden) != len(now) else []
    for number, (before, after) in enumerate(zip(golden, now, strict=False), start=2):
        result += differences(before, after, tolerance, f"{path.name}:{number} ")
    assert not result, "\n".join(result[:20])
    if is_identical():
        assert head["sha256"] == sha256(canonical(list(lines))), f"{path.name}: differs in the last digits or in a text"
