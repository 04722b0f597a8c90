"""Text for terminals that can do less: without colours, or without the signs that ASCII does not have."""

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
"""By the sign that this project's texts use, what stands for it."""

HANDLER = "coec.signs"
"""Name under which `codecs` knows what to do with a sign that an encoding lacks."""


def encodable(text: str, encoding: str) -> str:
    """The text with signs that the encoding has."""
    return text.encode(encoding, HANDLER).decode(encoding)


def is_unicode(encoding: str | None) -> bool:
    """Whether it has all signs."""
    return (encoding or "").lower().replace("-", "").replace("_", "").startswith("utf")


def never_fail() -> None:
    """No text that is printed from now on fails for want of a sign in the locale's encoding."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        # Whoever captures output brings a stream of his own.
        if reconfigure is not None and not is_unicode(stream.encoding):
            reconfigure(errors=HANDLER)


def wants_plain(environment: Mapping[str, str]) -> bool:
    """Whether a terminal is to be sent nothing but text: https://no-color.org, and terminals that obey nothing."""
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
