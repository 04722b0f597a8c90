"""What other packages add to coec, by entry points: the groups, and how they are read.

A name in a group stands for an object, `module:function`, or for a module. The names of commands are those that a
user types, with a dot before that of a subcommand of a group of coec's own (`models.assess`).
"""

from collections.abc import Callable
from importlib import metadata
from typing import Any

COMMANDS = "coec.commands"
"""Commands of `coec`: functions, or groups of commands (a `typer.Typer`)."""

FUNCTIONS = "coec.api"
"""Functions of the package `coec`."""

SOURCES = "coec.sources"
"""Layouts of recordings: modules, see `coec.io.recordings.recording_source.installed_layout`."""

EXPERIMENTS = "coec.experiments"
"""Experiments behind options of commands: modules, see `coec diagnose --detection`."""


def added_by_packages(group: str) -> dict[str, Callable[[], Any]]:
    """What the installed packages add to a group, by name: functions that load it."""
    return {point.name: point.load for point in metadata.entry_points(group=group)}
