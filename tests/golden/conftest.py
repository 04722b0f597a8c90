"""Fixtures of the golden decisions."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from golden.reference import IDENTITY, identity, is_identical, write


@pytest.fixture(scope="session")
def writes(request: pytest.FixtureRequest) -> bool:
    """Whether today's decisions replace the golden ones."""
    requested: bool = request.config.getoption("--write-golden")
    if requested:
        write(IDENTITY, identity())
    return requested


@pytest.fixture(autouse=True)
def _says_what_is_compared(writes: bool, record_property: Callable[[str, object], None]) -> None:
    del writes
    record_property("compared", "hashes and values" if is_identical() else "values")
