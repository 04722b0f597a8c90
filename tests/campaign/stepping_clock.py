"""`coec` with a wall clock of its own: `python stepping_clock.py FILE ARGS...`.

It is off from the machine's by the seconds that the file holds, read anew whenever somebody looks at it. The steady
clock and the times of files stay the machine's, and so does the wall clock of the worker, which never looks at it.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path


def put(path: Path, seconds: float) -> None:
    """Steps the clock that reads this file."""
    written = path.with_suffix(".written")
    written.write_text(str(seconds))
    written.replace(path)


def step(path: Path) -> None:
    """Puts the clock of this process by the seconds that the file says."""
    of_machine = time.time_ns

    def time_ns() -> int:
        return of_machine() + round(float(path.read_text()) * 1e9)

    time.time_ns = time_ns


if __name__ == "__main__":
    offset, *arguments = sys.argv[1:]
    step(Path(offset))
    sys.argv = ["coec", *arguments]

    from coec.cli.main import main

    sys.exit(main())
