"""Writes every page into the folder given as the only argument."""

from __future__ import annotations

import sys
from pathlib import Path

from generate import PAGES


def main(arguments: list[str]) -> int:
    """Runs the command line; returns the exit status."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m generate DIR\n")
        return 2
    for name, page in PAGES.items():
        (Path(arguments[0]) / name).write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
