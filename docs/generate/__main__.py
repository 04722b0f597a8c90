"""`python -m generate docs`: writes every page into the folder given as the only argument.

Both `docs` and `service` have to be in PYTHONPATH, unless coec is installed: `PYTHONPATH=docs python -m generate docs`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from generate.commands import commands_page, python_page
from generate.configuration import configuration_page
from generate.contract import keys_page, schemas_page
from generate.formats import formats_page
from generate.service import figures_page, health_page, metrics_page, operations_page

PAGES: Mapping[str, Callable[[], str]] = {
    "cli.md": commands_page,
    "configuration.md": configuration_page,
    "figures.md": figures_page,
    "formats.md": formats_page,
    "health.md": health_page,
    "keys.md": keys_page,
    "metrics.md": metrics_page,
    "operations.md": operations_page,
    "python.md": python_page,
    "schemas.md": schemas_page,
}
"""The function that makes each page, by its file."""


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
