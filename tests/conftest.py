"""Fixtures and rules for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

if TYPE_CHECKING:
    from e2e.processes import Router

REPOSITORY = Path(__file__).resolve().parent.parent
BENCHMARKS = REPOSITORY / "tests" / "bench"

# The same examples in every run, and no verdict from the speed of the machine.
hypothesis.settings.register_profile("coec", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("coec")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave benchmarks to the long run: how fast the machine is at the moment is no verdict on a change."""
    for item in items:
        if item.path.is_relative_to(BENCHMARKS):
            item.add_marker("slow")


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The folder of the sample recordings: $COEC_SAMPLE_DATA, else ../shared/data beside the checkout.

    Skips the test where that folder is absent.
    """
    configured = os.environ.get("COEC_SAMPLE_DATA")
    folder = Path(configured) if configured else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the sample recordings: {folder} is absent; COEC_SAMPLE_DATA may name another folder")
    return folder


@pytest.fixture(scope="session")
def router() -> Iterator[Router]:
    """The router of all services that a run starts, which come one after the other."""
    from e2e.processes import routing  # Zenoh and more, which most tests do without

    with routing() as found:
        yield found
