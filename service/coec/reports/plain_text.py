"""Text for limited terminals: without colours, or without signs outside ASCII."""

from __future__ import annotations

import codecs
import sys
from collections.abc import Mapping

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


def _substitute(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    found = "".join(SIGNS.get(sign, "?") for sign in lacking)
    try:
        found.encode(error.encoding)
    except UnicodeEncodeError:  # an encoding that lacks letters of ASCII, too
        found = "?" * len(lacking)
    return found, error.end


codecs.register_error(HANDLER, _substitute)
