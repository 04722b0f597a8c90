"""Windows that two vehicles recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.fleet import recorded_windows


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of them; not to be changed."""
    return recorded_windows(tmp_path_factory.mktemp("recorded"))
