"""Fixtures and rules for all tests."""

import os
from pathlib import Path

import hypothesis
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
BENCHMARKS = REPOSITORY / "tests" / "bench"

# The same examples in every run, and no verdict from the speed of the machine.
hypothesis.settings.register_profile("coec", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("coec")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave benchmarks to the long run, except their short forms, which are marked `ratio`."""
    for item in items:
        if item.path.is_relative_to(BENCHMARKS) and item.get_closest_marker("ratio") is None:
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
