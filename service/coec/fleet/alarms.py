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


def false_alarms(heartbeats: Iterable[LastWord]) -> FalseAlarms:
    """False alarms of all pairs together. Pairs whose word has no counts, because they are awaited, are left out."""
    counted = [
        (f"{heartbeat.vehicle}/{heartbeat.pair}", heartbeat.alarms)
        for heartbeat in heartbeats
        if heartbeat.alarms is not None
    ]
    watched_h = sum(alarms.watched_s for _, alarms in counted) / S_PER_H
    withdrawn = sum(alarms.withdrawn for _, alarms in counted)
    return FalseAlarms(
        pairs=len(counted),
        watched_h=watched_h,
        confirmed=sum(alarms.confirmed for _, alarms in counted),
        withdrawn=withdrawn,
        per_100_h=100.0 * withdrawn / watched_h if watched_h > 0.0 else None,
        per_100_h_at_most=100.0 * poisson_most(CONFIDENCE, withdrawn) / watched_h if watched_h > 0.0 else None,
        by_pair={name: alarms.withdrawn for name, alarms in sorted(counted, key=_most_first) if alarms.withdrawn},
    )


def _most_first(entry: tuple[str, Alarms]) -> tuple[int, str]:
    return -entry[1].withdrawn, entry[0]
