"""Every figure that a verdict may rest on, and every cause in the data, is explained with what to do about it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import coec.calibration
from coec.calibration.figures import FIGURES, OTHER_ADVICE
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import INTRINSICS_OFF, MOVED, StopReason
from coec.calibration.verdict import UNCERTAIN

NAMED = {"MOVED": MOVED, "INTRINSICS_OFF": INTRINSICS_OFF}
"""Figures whose name is a constant."""


def names_made() -> Iterator[str]:
    """Of the metrics that calibration makes, as patterns, as they stand in its source."""
    for path in Path(coec.calibration.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Metric" and node.args):
                continue
            match node.args[0]:
                case ast.Constant(value=str(name)):
                    yield re.escape(name)
                case ast.Name(id=name):
                    yield re.escape(NAMED[name])
                case ast.JoinedStr(values=parts):
                    yield "".join(
                        re.escape(str(part.value)) if isinstance(part, ast.Constant) else r"\w+" for part in parts
                    )
                case other:
                    raise AssertionError(f"{path}:{node.lineno}: {ast.unparse(other)} is no name that can be read")


def test_every_figure_is_explained_and_no_other() -> None:
    made = set(names_made())
    assert len(made) > 15
    assert [name for name in made if not any(re.fullmatch(name, known) for known in FIGURES)] == []
    assert [known for known in FIGURES if not any(re.fullmatch(name, known) for name in made)] == []


def test_what_is_reported_are_sentences() -> None:
    for figure in FIGURES.values():
        assert figure.measures.endswith(".")
        assert figure.advice.endswith(".")
        assert figure.fails
        assert not figure.fails.endswith(".")
        assert figure.title
    assert set(FIGURES) >= UNCERTAIN
    assert set(OTHER_ADVICE) == {*(stop.value for stop in StopReason if stop is not StopReason.TOLERANCE), "motion"}
    assert all(cause.advice.endswith(".") for cause in CAUSES.values())
