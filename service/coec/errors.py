"""Every error that coec raises on purpose: a sentence for people, an exit code and a reply code for programs. The exit
statuses of all commands: what each means, and whether a service manager starts the service again.
"""

import os
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path

from coec.untrusted import Untrusted, printable


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
    ExitCode.FAILED: "failure, or a negative verdict; standard error gives the reason. `run` and `router` never end "
    "with it",
    ExitCode.USAGE: "wrong usage of the command line",
    ExitCode.FAULT: "internal error of coec; of `run`: a thread died, and health reported it",
    ExitCode.UNAVAILABLE: "temporarily unavailable: a port, disk space, the lock of the state directory or the vehicle "
    "name is in use or missing; retry later",
    ExitCode.CONFIGURATION: "the configuration, or a file that it names, cannot be used: no permission, no depth "
    "network, no certificate. A restart does not help",
    ExitCode.INTERRUPTED: "Ctrl-C; `evaluate` prints and writes the finished part",
    ExitCode.BROKEN_PIPE: "the reader of the output closed the pipe",
}
"""Every exit status with its meaning."""

NOT_CURED_BY_RESTART = frozenset({ExitCode.USAGE, ExitCode.CONFIGURATION})
"""Exit statuses of `run` and `router` after which the unit of systemd does not start them again: the next start would
end alike."""

MAY_BE_CURED = frozenset({ExitCode.FAULT, ExitCode.UNAVAILABLE})
"""Exit statuses of `run` and `router` after which the unit starts them again."""


MAX_MESSAGE = 4000
"""Most characters of each line of a message. A configuration with many mistakes needs them; a message that quotes a
sender is bounded by `coec.untrusted.LIMIT` already."""


class CoecError(Exception):
    """Base of all deliberate errors. The message says what was wrong, where, and what to do.

    The first argument is one line. Further arguments are the program's own text and may have several lines. `str()`
    escapes every other control character, because a message may quote a file, a recording or a reply.

    Attributes:
        exit_code: process exit status of a command that ends with this error (CONTRACT, "Command line").
        reply_code: machine-readable code of a Zenoh `reply_err` that carries this error.
        details: figures that `--json` gives beside the message, by name.
    """

    exit_code = ExitCode.FAILED
    reply_code = "internal"
    details: Mapping[str, object] = {}

    def __str__(self) -> str:
        first, *more = self.args or ("",)
        lines = [str(first), *(line for text in more for line in str(text).split("\n"))]
        return "\n".join(printable(line, MAX_MESSAGE) for line in lines)


class UsageError(CoecError):
    """A command, selector or payload that does not fit its own grammar."""

    exit_code = ExitCode.USAGE
    reply_code = "bad_request"


class ConfigError(CoecError):
    """A configuration that cannot be used: unknown key, wrong type, value out of range, missing file."""

    exit_code = ExitCode.CONFIGURATION
    reply_code = "bad_configuration"


class UnavailableError(CoecError):
    """The service needs something that it cannot have now: the port, the state directory or the vehicle's place on
    the network is taken, absent or not writable. The configuration is right, and a later start may succeed."""

    exit_code = ExitCode.UNAVAILABLE
    reply_code = "unavailable"


class SourceError(CoecError):
    """A recording that is absent, incomplete or not in the layout its name promises."""

    reply_code = "bad_source"


class MisreadError(SourceError):
    """A recording whose frames are not what they are taken for: in another unit, or measured from another origin."""


class WindowError(CoecError):
    """A window file that cannot be read, or that holds too little to calibrate from."""

    reply_code = "bad_window"


class ModelError(CoecError):
    """A depth network that is missing, corrupt, or does not match its model card."""

    reply_code = "bad_model"


class CalibrationError(CoecError):
    """A window from which no calibration can be computed (for example: no LiDAR point in view)."""

    reply_code = "calibration_failed"


class LensError(CalibrationError):
    """A camera model that does not fit the lens that it should describe."""

    reply_code = "lens_does_not_fit"

    def __init__(self, message: str, details: Mapping[str, object]) -> None:
        super().__init__(message)
        self.details = details


class StateError(CoecError):
    """A state file that is damaged or of another schema version."""

    reply_code = "bad_state"


class RecordingError(CoecError):
    """A window that could not be written (disk full, folder not writable)."""

    reply_code = "recording_failed"


class NotFoundError(CoecError):
    """A window, pair or key that does not exist."""

    reply_code = "not_found"


class DecodeError(CoecError):
    """A message or image that was refused before it could do harm.

    Attributes:
        reason: short code under which the loss is counted, for example `image_truncated`. It is one of a fixed
            set and never holds text from the sender.
    """

    reply_code = "bad_input"

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class OutputError(CoecError):
    """A requested file could not be written."""

    reply_code = "output_failed"


class NotAcceptedError(CoecError):
    """Somebody asked to write a calibration into the files of a vehicle, but its own verdict rejects it."""

    reply_code = "not_accepted"


class ConnectionFailedError(CoecError):
    """There is no router to connect to."""

    reply_code = "not_connected"


class RemoteError(CoecError):
    """An error reply; `code` and `message` are those that the sender gave."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(Untrusted(message))
        self.reply_code = Untrusted(code)


class NotProvenError(CoecError):
    """The sender has not shown a certificate that the service accepts."""

    reply_code = "not_proven"


def cannot_read(path: Path, error: OSError, what: str = "") -> str:
    """A sentence about a file that this process cannot read. If the permission is missing, it names what refuses it,
    its owner and mode, the user of this process, and what to do. `what` says which file it is, as `mask`."""
    named = f"cannot read {what} {path}" if what else f"cannot read {path}"
    if isinstance(error, PermissionError):
        return f"{named}: {permission_denied(path, 'r')}"
    if isinstance(error, IsADirectoryError):
        return f"{named}: it is a folder; container engines make one if the file to mount does not exist"
    return f"{named}: {error.strerror or type(error).__name__}"


def require_readable(path: Path, where: str) -> None:
    """Checks that this process can read a file that the configuration names at `where`.

    Raises:
        ConfigError: it cannot.
    """
    try:
        with path.open("rb"):
            pass
    except FileNotFoundError:
        raise ConfigError(f"{where}: there is no file {path}") from None
    except OSError as error:
        raise ConfigError(f"{where}: {cannot_read(path, error)}") from None


def permission_denied(path: Path, access: str) -> str:
    """Who is refused by what, and how to permit it. `access` is `r` for a file to read, `rwx` for a folder to write."""
    folders = [folder for folder in reversed(path.parents) if folder.is_dir() and not os.access(folder, os.X_OK)]
    refusing, needed = (folders[0], "x") if folders else (path, access)
    user, group = os.geteuid(), os.getegid()
    try:
        status = refusing.stat()
    except OSError:
        return f"permission denied for user {user}, group {group}; see to the owner and the mode of {refusing}"
    return (
        f"permission denied: {refusing} belongs to user {status.st_uid}, group {status.st_gid}, with mode "
        f"{status.st_mode & 0o7777:04o}, and this process has user {user}, group {group}; permit it, for example with "
        f"`chgrp {group} {refusing} && chmod g+{needed} {refusing}`"
    )
