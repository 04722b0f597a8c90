"""Hurried windows of a drawn rig: when a pair suspects a move, a window is cut at once, and its result counts beside
the looks (`calibration.monitor.urgency`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coec.calibration.monitor.urgency import TRIES
from coec.calibration.rig.evidence import observation_of_window
from coec.calibration.rig.types import Edge
from coec.config import MonitorConfig
from coec.evaluation.rig_evidence import NS_PER_S, Happening, Lasting, SimulatedRig, TimedEvidence, window_of
from coec.geometry import se3

SLICE_S = MonitorConfig().urgent_slice_s

SUSPECTED = 2
"""Flagged looks in a row after which a pair suspects a move: a simulated vehicle that is looked at every five seconds
suspects after nine."""

TAKES_S = (3.0, 18.0)
"""From the end of a slice to its answer: a window of 25 frames takes the worker four seconds, and up to four pairs of a
knocked LiDAR wait for each other."""

ACCEPTED = 0.7
"""Share of windows that are accepted: 73 of 108 on the simulated streets of `coec sim matrix`, including night, rain
and wrong lenses. None of them was wrong."""


def urgent_evidence(
    rig: SimulatedRig, drive: Happening, checks: Sequence[TimedEvidence], lasting: Lasting, rng: np.random.Generator
) -> list[TimedEvidence]:
    """Results of accepted windows, in the order in which they become known; `looks` are those at all pairs."""
    evidence: list[TimedEvidence] = []
    for edge in rig.graph.edges:
        if edge.name not in rig.graph.of_lidars:
            evidence += _of_pair(edge, drive, [one for one in checks if one[1].edge == edge.name], lasting, rng)
    return sorted(evidence, key=lambda one: (one[0], one[1].edge))


def _of_pair(
    edge: Edge, drive: Happening, checks: Sequence[TimedEvidence], lasting: Lasting, rng: np.random.Generator
) -> list[TimedEvidence]:
    """Results for one pair: at most `TRIES` windows per suspicion, one after the other."""
    evidence: list[TimedEvidence] = []
    flagged, tries, known_s = 0, 0, -np.inf
    for at_s, check in checks:
        if check.stepped_ns is None:
            flagged = tries = 0
            continue
        flagged += 1
        if flagged < SUSPECTED or tries == TRIES or at_s < known_s:
            continue
        tries += 1
        end_s = at_s + SLICE_S
        known_s = end_s + float(rng.uniform(*TAKES_S))
        offset_at_start, offset_at_end = drive.where(edge, at_s), drive.where(edge, end_s)
        # A window during which the mount moved is refused.
        if rng.random() < ACCEPTED and np.array_equal(offset_at_start, offset_at_end):
            measured = window_of(se3.perturb(edge.T_a_b, offset_at_end), lasting.lens[edge.a], rng)
            window_evidence = observation_of_window(edge.name, measured)
            assert window_evidence is not None
            evidence.append((known_s, replace(window_evidence, stamp_ns=round(at_s * NS_PER_S))))
    return evidence
