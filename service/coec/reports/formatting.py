"""Text for people: figures with true minus signs and no more digits than can be read, counts, stamps (in UTC where a
stamp is a date); and what a limited terminal can show: text without colours, or without signs outside ASCII.

Beside `coec.reports.console` this is the one place from which text goes to standard output and standard error. It
imports nothing heavy: the service itself uses it.
"""

import codecs
import logging
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from math import floor, isfinite, log10

from coec.untrusted import printable_lines

NONE = "–"
"""Stands where there is no number."""

GROUPED_FROM = 10_000
"""Numbers from here on have their digits in threes."""


def number(value: float | None, digits: int = 3, sign: bool = False) -> str:
    """A number with so many digits after the point."""
    if value is None or not isfinite(value):
        return NONE
    # Adding zero turns -0 into 0.
    return _true_minus(f"{round(value, digits) + 0.0:{'+' if sign else ''}.{digits}f}")


def significant(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; all digits before the point are kept."""
    if value is None or not isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    after = min(max(digits - 1 - floor(log10(abs(value))), 0), 6)
    text = f"{value:.{after}f}"
    if abs(value) >= GROUPED_FROM:
        text = f"{value:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return _true_minus(text)


def count(value: int, one: str, several: str | None = None) -> str:
    """So many of something: `1 pair`, `2 pairs`."""
    return f"{value} {one if value == 1 else several or one + 's'}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share of 1 in percent."""
    return NONE if share is None or not isfinite(share) else f"{100.0 * share:.{digits}f}\N{NARROW NO-BREAK SPACE}%"


def size(vector: Sequence[float | None]) -> float | None:
    """Euclidean length; None where a component is missing."""
    known = [value for value in vector if value is not None]
    return sum(value * value for value in known) ** 0.5 if len(known) == len(vector) else None


def _true_minus(text: str) -> str:
    return text.replace("-", "−")


NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000

FIRST_DATE_NS = 946_684_800 * NS_PER_S
"""Start of the year 2000. Stamps before it count from something else, mostly from when a sensor was switched on."""

END_NS = 253_402_300_800 * NS_PER_S
"""End of the year 9999, the last one that ISO 8601 writes with four digits."""


def instant(stamp_ns: int) -> str:
    """The stamp of a frame, to the millisecond."""
    if not _is_date(stamp_ns):
        return _bare(stamp_ns)
    beyond_ms = stamp_ns // NS_PER_MS % 1000
    return f"{_date(stamp_ns):%Y-%m-%d %H:%M:%S}.{beyond_ms:03d}Z"


def second(stamp_ns: int) -> str:
    """The stamp of an event, to the second."""
    return f"{_date(stamp_ns):%Y-%m-%d %H:%M:%S}Z" if _is_date(stamp_ns) else _bare(stamp_ns)


def day(stamp_ns: int) -> str:
    """The day of a stamp."""
    return f"{_date(stamp_ns):%Y-%m-%d}" if _is_date(stamp_ns) else _bare(stamp_ns)


def _is_date(stamp_ns: int) -> bool:
    return FIRST_DATE_NS <= stamp_ns < END_NS


def _date(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC)


def _bare(stamp_ns: int) -> str:
    return f"{stamp_ns / NS_PER_S:.3f} s"


def hold_text(sender: str, since_ns: int | None, reason: str | None) -> str:
    """By whom, since when and why, as far as that is known; the beginning of a sentence."""
    who = f" by {sender}" if sender else " by command"
    since = "" if since_ns is None else f" since {second(since_ns)}"
    return f"held{who}{since}: {reason or 'no reason was given'}"


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
