"""Paths below a home directory, written with `~`."""

from __future__ import annotations

import os
from pathlib import Path


def expand_home(path: str) -> Path:
    """A path with a leading `~` or `~name` replaced by that user's home. It stays as it is if the user has no home, as
    the dynamic user that a service manager creates for a service."""
    return Path(os.path.expanduser(path))  # noqa: PTH111  pathlib's own raises where there is no home
