"""Paths below a home directory, as people and configurations write them."""

from __future__ import annotations

import os
from pathlib import Path


def from_home(path: str) -> Path:
    """A path with `~` or `~name` at its beginning read as that user's home; as it stands where there is none: the user
    that a service manager makes up for a service has no home."""
    return Path(os.path.expanduser(path))  # noqa: PTH111  pathlib's own raises where there is no home
