"""`coec watch`: shows a fleet on one screen, or prints a line per change of one vehicle, for programs and logs."""

from __future__ import annotations

import sys

from coec.cli import watch_board, watch_lines
from coec.cli.commands.watch import Options
from coec.cli.query import asked_of
from coec.errors import UsageError

EVERY_VEHICLE = "*"


def run(options: Options) -> int:
    """Shows until told to stop; returns 1 if nothing was heard at all.

    Raises:
        ConfigError: the session's configuration cannot be used.
        ConnectionFailedError: no router answered.
        UsageError: an unknown state, or options of both forms.
    """
    of_board = options.once or bool(options.states) or bool(options.find)
    of_lines = options.lines or options.seconds is not None
    if of_board and of_lines:
        raise UsageError("--once, --state and --find are about the board, --lines and --seconds about lines")
    on_screen = sys.stdout.isatty() and not options.as_json
    if of_lines or not (of_board or on_screen):
        asked = asked_of(options.config, options.vehicle, options.prefix, options.connect, options.zenoh)
        return watch_lines.run(options, asked)
    vehicle = EVERY_VEHICLE if options.vehicle is None and options.config is None else options.vehicle
    asked = asked_of(options.config, vehicle, options.prefix, options.connect, options.zenoh)
    if not (options.once or on_screen):
        raise UsageError("the board needs a terminal: give --once, or --lines")
    return watch_board.run(options, asked)
