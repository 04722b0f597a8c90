"""The service in this process."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def unsynchronised() -> Iterator[None]:
    """Nobody cuts the power: what is written is not waited for, as a pair does several times at each check. What is
    written after a power cut the tests of `support.disk` say, which note each call before it comes here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield
