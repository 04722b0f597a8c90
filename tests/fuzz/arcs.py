"""Which way an input takes through our code: the signal that tells a fuzzer what is worth keeping."""

from __future__ import annotations

import sys
from pathlib import Path
from types import CodeType, FrameType, TracebackType
from typing import Any

Arc = tuple[str, int, int, int]
"""File, line, the line after it, and how often that happened: 1, 2, 3, 4 for up to 7, 5 for up to 31, 6 for more."""

_MORE_THAN = (1, 2, 3, 7, 31)


class Arcs:
    """Notes which line followed which in the code below a folder, while it is entered.

    By `sys.settrace`: Python 3.11 has nothing quicker, and code outside the folder costs one call a function.
    """

    def __init__(self, folder: Path) -> None:
        self._prefix = f"{folder}/"
        self._names: dict[CodeType, str] = {}
        self._counts: dict[tuple[str, int, int], int] = {}

    def __enter__(self) -> Arcs:
        self._counts = {}
        sys.settrace(self._call)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        sys.settrace(None)

    @property
    def taken(self) -> set[Arc]:
        """What was noted since it was entered."""
        return {(*arc, 1 + sum(count > more for more in _MORE_THAN)) for arc, count in self._counts.items()}

    def _call(self, frame: FrameType, event: str, argument: object) -> Any:
        del event, argument
        name = self._names.get(frame.f_code)
        if name is None:
            path = frame.f_code.co_filename
            name = path.removeprefix(self._prefix) if path.startswith(self._prefix) else ""
            self._names[frame.f_code] = name
        if not name:
            return None
        counts, last = self._counts, 0

        def line(frame: FrameType, event: str, argument: object) -> Any:
            nonlocal last
            del event, argument
            arc = (name, last, frame.f_lineno)
            counts[arc] = counts.get(arc, 0) + 1
            last = frame.f_lineno
            return line

        return line
