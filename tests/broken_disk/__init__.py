"""A disk that is full, read-only or slow for the processes of a service, and only for them; see `sitecustomize`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from e2e.processes import added_to_environment

WELL, FULL, READ_ONLY, SLOW = "well", "full", "read-only", "slow 100000"


class BrokenDisk:
    """The disk below a folder, as the processes that are started in `on_path` see it."""

    def __init__(self, root: Path, file: Path) -> None:
        """`file`, which says how the disk is, must not lie below `root`."""
        self._root = root
        self._file = file
        self.becomes(WELL)

    def becomes(self, state: str) -> None:
        """Well, full, and so on."""
        fresh = self._file.with_suffix(".fresh")
        fresh.write_text(state)
        fresh.replace(self._file)

    @contextmanager
    def on_path(self) -> Iterator[None]:
        """Processes that are started meanwhile have it."""
        path = os.pathsep.join(filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")]))
        names = {"PYTHONPATH": path, "COEC_BROKEN_DISK": str(self._root), "COEC_BROKEN_DISK_IS": str(self._file)}
        with added_to_environment(names):
            yield
