"""The exit statuses of all commands: what each means, and whether a service manager starts the service again."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit status of a command. The numbers from 64 to 78 are those of sysexits.h."""

    SUCCESS = 0
    FAILED = 1
    USAGE = 2
    FAULT = 70
    UNAVAILABLE = 75
    CONFIGURATION = 78
    INTERRUPTED = 130
    """As a shell reports a process ended by SIGINT."""
    BROKEN_PIPE = 141
    """As a shell reports a process ended by SIGPIPE."""


EXIT_CODE_MEANINGS: Mapping[ExitCode, str] = {
    ExitCode.SUCCESS: "success; of `calibrate`: accepted; of `doctor`: nothing failed; of `run`: stopped by a signal",
    ExitCode.FAILED: "the work failed, or the verdict is negative; standard error says why. `run` and `router` never "
    "end with it",
    ExitCode.USAGE: "the command line does not fit",
    ExitCode.FAULT: "a fault of coec itself; of `run`: a thread died, and health has said so",
    ExitCode.UNAVAILABLE: "what a start needs is taken or away, and may be there later: a port, space on the disk of "
    "the state directory, its lock, the vehicle's place on the network",
    ExitCode.CONFIGURATION: "the configuration, or a file that it names, cannot be used: no permission, no depth "
    "network, no certificate. Only a person can cure it",
    ExitCode.INTERRUPTED: "Ctrl-C; `evaluate` prints and writes what was finished by then",
    ExitCode.BROKEN_PIPE: "whoever read the output has gone",
}
"""Every exit status with its meaning."""

NOT_CURED_BY_RESTART = frozenset({ExitCode.USAGE, ExitCode.CONFIGURATION})
"""Exit statuses of `run` and `router` after which the unit of systemd does not start them again: the next start would
end alike."""

MAY_BE_CURED = frozenset({ExitCode.FAULT, ExitCode.UNAVAILABLE})
"""Exit statuses of `run` and `router` after which the unit starts them again."""
