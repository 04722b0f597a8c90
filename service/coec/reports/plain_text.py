"""Text for limited terminals: without colours, or without signs outside ASCII; and the one place, beside
`coec.reports.console`, from which text goes to standard output and standard error."""

from __future__ import annotations

import codecs
import logging
import sys
import threading
import traceback
from collections.abc import Mapping

from coec.untrusted import printable_lines

SIGNS: Mapping[str, str] = {
    "°": "deg", "±": "+-", "≥": ">=", "≤": "<=", "✓": "ok", "✗": "x", "·": "*", "×": "x", "−": "-", "–": "-", "—": "-",
    "²": "^2", "³": "^3", "⁻": "^-", "¹": "1", "σ": "sigma", "ω": "omega", "ξ": "xi", "π": "pi", "µ": "u", "μ": "u",
    "Σ": "Sum", "√": "sqrt", "→": "->", "←": "<-", "…": "...", "≈": "~", "‘": "'", "’": "'", "“": '"', "”": '"',
    "∞": "inf", "▁": "_", "▂": "_", "▃": "-", "▄": "-", "▅": "=", "▆": "=", "▇": "#", "█": "#", "▀": "#", "─": "-",
    "│": "|", "━": "-", "╸": "-", "╺": "-", "•": "*", "Δ": "d", "θ": "theta", "¼": "1/4", "½": "1/2", "\ufffd": "?",
}  # fmt: skip
"""ASCII replacement of each sign that this project's texts use."""

HANDLER = "coec.signs"
"""Name of the `codecs` error handler that replaces signs that an encoding lacks."""


def encodable(text: str, encoding: str) -> str:
    """The text with only signs that the encoding has."""
    return text.encode(encoding, HANDLER).decode(encoding)


def is_unicode(encoding: str | None) -> bool:
    """Whether an encoding has all signs."""
    return (encoding or "").lower().replace("-", "").replace("_", "").startswith("utf")


def write(text: str, *, on_error: bool = False) -> None:
    """Writes text to standard output, or to standard error. Control characters in it other than line breaks are
    escaped, whatever it was made of."""
    stream = sys.stderr if on_error else sys.stdout
    stream.write(printable_lines(text))
    stream.flush()


def write_traceback(error: BaseException) -> None:
    """Writes the traceback of an exception, whose text may quote a reply or a file, to standard error."""
    write("".join(traceback.format_exception(error)), on_error=True)


def escape_interpreter() -> None:
    """From now on, what the interpreter itself prints is escaped too: tracebacks of threads and of callbacks, and log
    records of a command that configures no log. A hook that somebody else has set stays."""

    def of_thread(arguments: threading.ExceptHookArgs) -> None:
        if arguments.exc_value is not None and not isinstance(arguments.exc_value, SystemExit):
            write_traceback(arguments.exc_value)

    if threading.excepthook is threading.__excepthook__:
        threading.excepthook = of_thread
    if sys.excepthook is sys.__excepthook__:
        sys.excepthook = lambda _, error, __: write_traceback(error)
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_EscapingFormatter())


def never_fail() -> None:
    """From now on, printing never fails because the locale's encoding lacks a sign."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        # A stream that captures output may have no `reconfigure`.
        if reconfigure is not None and not is_unicode(stream.encoding):
            reconfigure(errors=HANDLER)


def wants_plain(environment: Mapping[str, str]) -> bool:
    """Whether to send the terminal nothing but text: with NO_COLOR (https://no-color.org), or for a dumb terminal."""
    return bool(environment.get("NO_COLOR")) or environment.get("TERM", "").lower() in ("dumb", "unknown")


class _EscapingFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable_lines(super().format(record))


def _substitute(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    replacement = "".join(SIGNS.get(sign, "?") for sign in lacking)
    try:
        replacement.encode(error.encoding)
    except UnicodeEncodeError:  # an encoding that lacks letters of ASCII, too
        replacement = "?" * len(lacking)
    return replacement, error.end


codecs.register_error(HANDLER, _substitute)
