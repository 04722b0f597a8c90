"""Every error that coec raises on purpose: a sentence for people, an exit code and a reply code for programs."""

from __future__ import annotations

from collections.abc import Mapping

from coec.untrusted import Untrusted, printable

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

    exit_code = 1
    reply_code = "internal"
    details: Mapping[str, object] = {}

    def __str__(self) -> str:
        first, *more = self.args or ("",)
        lines = [str(first), *(line for text in more for line in str(text).split("\n"))]
        return "\n".join(printable(line, MAX_MESSAGE) for line in lines)


class UsageError(CoecError):
    """A command, selector or payload that does not fit its own grammar."""

    exit_code = 2
    reply_code = "bad_request"


class ConfigError(CoecError):
    """A configuration that cannot be used: unknown key, wrong type, value out of range, missing file."""

    exit_code = 78  # EX_CONFIG of sysexits.h, so that systemd does not restart on it
    reply_code = "bad_configuration"


class UnavailableError(CoecError):
    """The service needs something that it cannot have now: the port, the state directory or the vehicle's place on
    the network is taken, absent or not writable. The configuration is right, and a later start may succeed."""

    exit_code = 75  # EX_TEMPFAIL of sysexits.h: a service manager tries again
    reply_code = "unavailable"


class SourceError(CoecError):
    """A recording that is absent, incomplete or not in the layout its name promises."""

    reply_code = "bad_source"


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
