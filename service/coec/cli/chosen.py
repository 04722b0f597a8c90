"""The options of the command line that decide how a recording is calibrated."""

from __future__ import annotations

from typing import Protocol

from coec.library.choices import Choices


class Chosen(Protocol):
    """Options that several commands share; None = not given."""

    @property
    def depth(self) -> str | None: ...
    @property
    def objective(self) -> str | None: ...
    @property
    def dof(self) -> str | None: ...
    @property
    def no_motion_compensation(self) -> bool: ...


def choices_of(options: Chosen) -> Choices:
    """The choices that were given on the command line."""
    return Choices(
        depth=options.depth,
        objective=options.objective,
        dof=None if options.dof is None else int(options.dof),
        motion_compensation=False if options.no_motion_compensation else None,
    )
