"""Where an axis has its ticks."""

from __future__ import annotations

from math import ceil, floor, isfinite, log10

STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Distance between two ticks of a linear axis, times a power of ten."""

LOG_STEPS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0))
"""Ticks within a decade of a logarithmic axis, the sparsest choice first."""

LOG_ENOUGH = 3
"""Fewest ticks of a logarithmic axis, if its decades allow."""


def linear_ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between the two ends: as many as possible, but at most `most` (2 or more)."""
    if not (isfinite(low) and isfinite(high)) or high <= low:
        return [low]
    rough = (high - low) / most
    decade = 10.0 ** floor(log10(rough))
    for step in (factor * decade * scale for scale in (1.0, 10.0) for factor in STEPS):
        first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
        if last - first + 1 <= most:
            return [round(number * step, 12) for number in range(first, last + 1)]
    return [low, high]


def logarithmic_ticks(low: float, high: float) -> list[float]:
    """Round numbers between the two ends, which must be above zero."""
    values: list[float] = []
    for steps in LOG_STEPS:
        values = [
            step * 10.0**decade
            for decade in range(floor(log10(low)), ceil(log10(high)) + 1)
            for step in steps
            if low * (1 - 1e-9) <= step * 10.0**decade <= high * (1 + 1e-9)
        ]
        if len(values) >= LOG_ENOUGH:
            return values
    return values


def tick_label(value: float) -> str:
    """A number in its shortest form, with a true minus."""
    return f"{value:g}".replace("-", "−")
