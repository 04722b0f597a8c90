"""The lowest versions that pyproject.toml allows, and the newest that there are: the tests pass with both."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from real.packages import copied_checkout, environment, require_index, run_tests

pytestmark = pytest.mark.slow

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

FOLDERS = ("cli", "fleet", "fuzz/test_corpus.py", "geometry", "io", "schemas", "service")
"""Where packages of others decide: formats, messages, commands, stores, kernels; and the worker, which needs all."""

LOWEST, NEWEST = ("--resolution", "lowest-direct"), ("--resolution", "highest", "--upgrade")


@pytest.mark.parametrize("resolution", [LOWEST, NEWEST], ids=["lowest", "newest"])
def test_the_versions_at_both_ends_work(resolution: tuple[str, ...], tmp_path: Path, record_property: Record) -> None:
    require_index(tmp_path / "probe")
    checkout = copied_checkout(tmp_path / "coec")
    interpreter = environment(tmp_path / "environment", "python3.11", checkout, *resolution)
    single = [path.name for path in (checkout / "tests").glob("test_*.py") if path.name != "test_readme.py"]
    tests = [f"tests/{name}" for name in (*FOLDERS, *sorted(single))]
    record_property("figure", run_tests(interpreter, checkout, tests))
