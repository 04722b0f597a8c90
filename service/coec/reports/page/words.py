"""Numbers as a page writes them: true minus signs, no more digits than can be read."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, isfinite, log10

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
