"""Run time against the number of frames, as in table 2 of Borer et al. 2023: one averaged MI, and a whole search."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians

import numpy as np

from coec.adapters.depth.maps import open_depth
from coec.calibration.estimators import depth_features, prepare_window_data
from coec.calibration.objective.mutual_information import build_mutual_information
from coec.calibration.ports import Silence
from coec.calibration.search.local_search import box_of
from coec.config import CalibrationConfig, LimitsConfig
from coec.evaluation.experiments import Bench, Stages, greys_of, inferred
from coec.geometry import se3
from coec.sources import windows

FRAME_COUNTS = (5, 25, 50)
"""Those of the paper."""

REPEATS, SOLVES = 20, 3
"""Runs of which the fastest counts, because other load on the machine only ever adds time."""

START = np.array([radians(3.0), radians(-3.0), radians(2.6), 0.0, 0.0, 0.0])
"""5.0° from the source's calibration, about all three axes."""


@dataclass(frozen=True, slots=True)
class RunTime:
    """Milliseconds of one evaluation and of one solve at one number of frames, with depth inferred beforehand."""

    frames: int
    mi_ms: float
    solve_ms: float


def run_times(source: str, configuration: CalibrationConfig, stages: Stages) -> list[RunTime]:
    """Run times for each of `FRAME_COUNTS`; a count that the source does not reach is replaced by all its frames.

    Raises:
        CoecError: the source cannot be read, or cannot be solved.
    """
    load = stages.begin("load 50", None)
    window = windows.load_window(source, None, FRAME_COUNTS[-1], lambda done, _: load(done, "")).window
    depth = inferred(window, open_depth(configuration.depth, LimitsConfig()), stages.begin("depth", len(window.pairs)))
    bench = Bench(window, depth, greys_of(window), configuration)
    on_progress = stages.begin("run time", len(FRAME_COUNTS))
    times = []
    for count in sorted({min(count, len(window.pairs)) for count in FRAME_COUNTS}):
        times.append(_run_time(bench, windows.evenly_spread(len(window.pairs), count)))
        on_progress(len(times), f"{count} frames")
    return times


def _run_time(bench: Bench, indices: list[int]) -> RunTime:
    window = replace(bench.window, pairs=tuple(bench.window.pairs[index] for index in indices))
    window_data = prepare_window_data(window, bench.depth, bench.images, bench.configuration, Silence())
    features = depth_features(window_data, bench.reference)
    box = box_of(bench.configuration.search)
    mutual = build_mutual_information(features, window.rig, bench.reference, box, bench.configuration.objective)
    start = se3.perturb(bench.reference, START)
    return RunTime(
        frames=len(indices),
        mi_ms=_fastest_ms(lambda: mutual.evaluate(start), REPEATS),
        solve_ms=_fastest_ms(lambda: bench.solve(start, indices), SOLVES),
    )


def _fastest_ms(work: Callable[[], object], repeats: int) -> float:
    work()  # compiles, and fills the caches of decoded pictures
    fastest_s = float("inf")
    for _ in range(repeats):
        began_s = time.perf_counter()
        work()
        fastest_s = min(fastest_s, time.perf_counter() - began_s)
    return 1000.0 * fastest_s
