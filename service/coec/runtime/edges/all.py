"""Starts looks at every two LiDARs of a vehicle."""

from __future__ import annotations

from collections.abc import Iterable

from coec.calibration.types import Reason
from coec.config import LidarEdgesConfig, PairConfig
from coec.runtime.budget.budget import Budget
from coec.runtime.edges.plan import NOT_INSTALLED, plan_lidar_pairs
from coec.runtime.edges.stream import LidarPairStream
from coec.runtime.ingest.intake import Intake
from coec.runtime.rig.keeper import RigEstimatorThread
from coec.runtime.rig.lidar_side import LidarPairStatus, LidarState
from coec.runtime.worker.supervisor import Worker


class LidarPairs:
    """The edges between all LiDARs of a vehicle. For the main thread.

    Attributes:
        trouble: why no LiDARs are looked at, if people can change that; else None.
    """

    def __init__(
        self, config: LidarEdgesConfig, intake: Intake, worker: Worker, budget: Budget, rig: RigEstimatorThread
    ) -> None:
        self._period_s = config.period_s
        self._intake = intake
        self._worker = worker
        self._budget = budget
        self._rig = rig
        self._names: set[str] = set()
        self.problem: Reason | None = None

    def grow(self, pairs: Iterable[PairConfig]) -> None:
        """Takes all present pairs, which the rig knows already, and begins to look at every two of their LiDARs that
        are new.

        Raises:
            ConfigError: the rig of a pair cannot be built.
        """
        for lidars in plan_lidar_pairs(pairs, self._period_s):
            if lidars.edge.name in self._names:
                continue
            self._names.add(lidars.edge.name)
            why_not = lidars.why_not
            if why_not is None:
                LidarPairStream(lidars, self._period_s, self._intake, self._worker, self._budget, self._rig)
                continue
            self._rig.join_lidars(LidarPairStatus(lidars.edge, LidarState.NOT_MEASURED, (why_not,)), lambda: True)
            if why_not is NOT_INSTALLED:
                self.problem = why_not
