"""False alarms of a fleet's pairs: the vehicles count them, and this adds them up."""

from __future__ import annotations

from collections.abc import Iterable

from coec.calibration.commissioning.quantiles import poisson_most
from coec.schemas.fleet import FalseAlarms
from coec.schemas.last_word import LastWord
from coec.schemas.replies import Alarms

S_PER_H = 3600.0

CONFIDENCE = 0.95
"""Confidence of the upper bound on the rate."""


def false_alarms(words: Iterable[LastWord]) -> FalseAlarms:
    """False alarms of all pairs together. Pairs whose word has no counts, because they are awaited, are left out."""
    told = [(f"{word.vehicle}/{word.pair}", word.alarms) for word in words if word.alarms is not None]
    watched_h = sum(alarms.watched_s for _, alarms in told) / S_PER_H
    withdrawn = sum(alarms.withdrawn for _, alarms in told)
    return FalseAlarms(
        pairs=len(told),
        watched_h=watched_h,
        confirmed=sum(alarms.confirmed for _, alarms in told),
        withdrawn=withdrawn,
        per_100_h=100.0 * withdrawn / watched_h if watched_h > 0.0 else None,
        per_100_h_at_most=100.0 * poisson_most(CONFIDENCE, withdrawn) / watched_h if watched_h > 0.0 else None,
        by_pair={name: alarms.withdrawn for name, alarms in sorted(told, key=_most_first) if alarms.withdrawn},
    )


def _most_first(told: tuple[str, Alarms]) -> tuple[int, str]:
    return -told[1].withdrawn, told[0]
