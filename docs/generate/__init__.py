"""`python -m generate docs`: writes pages of the documentation from the tables that the code runs on."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from generate.commands import commands_page
from generate.configuration import configuration_page
from generate.contract import keys_page, schemas_page
from generate.figures import figures_page
from generate.python_api import python_page
from generate.service import metrics_page, operations_page

PAGES: Mapping[str, Callable[[], str]] = {
    "cli.md": commands_page,
    "configuration.md": configuration_page,
    "figures.md": figures_page,
    "keys.md": keys_page,
    "metrics.md": metrics_page,
    "operations.md": operations_page,
    "python.md": python_page,
    "schemas.md": schemas_page,
}
"""The function that makes each page, by its file."""
