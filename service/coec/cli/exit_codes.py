"""The exit statuses of commands, and their meaning."""

from __future__ import annotations

from collections.abc import Mapping

from coec.errors import CoecError, ConfigError, UnavailableError, UsageError

SUCCESS = 0
FAULT = 70
"""EX_SOFTWARE of sysexits.h."""

INTERRUPTED = 130
"""Status that a shell reports for a process ended by SIGINT."""

BROKEN_PIPE = 141
"""Status that a shell reports for a process ended by SIGPIPE."""

EXIT_CODES: Mapping[int, str] = {
    SUCCESS: "success; of `calibrate`: accepted; of `doctor`: nothing failed; of `run`: stopped as it was told to",
    CoecError.exit_code: "the work failed, or the verdict is negative; standard error says why",
    UsageError.exit_code: "the command line does not fit",
    FAULT: "a fault of coec itself; of `run`: a thread died, and health has said so",
    UnavailableError.exit_code: "what a start needs is taken or away, and may be there later: a port, the state "
    "directory, the vehicle's place on the network. The unit of systemd tries again",
    ConfigError.exit_code: "the configuration cannot be used. The unit of systemd does not try again",
    INTERRUPTED: "Ctrl-C; `evaluate` prints and writes what was finished by then",
    BROKEN_PIPE: "whoever read the output has gone",
}
"""All exit statuses with their meaning."""
