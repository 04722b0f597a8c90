"""All LiDARs of a vehicle, two by two."""

from __future__ import annotations

from collections.abc import Iterable

from coec.calibration.types import Reason
from coec.config import LidarEdgesConfig, PairConfig
from coec.runtime.budget.budget import Budget
from coec.runtime.edges.plan import NOT_INSTALLED, planned
from coec.runtime.edges.stream import LidarEdgeStream
from coec.runtime.ingest.intake import Intake
from coec.runtime.rig.keeper import RigKeeper
from coec.runtime.rig.lidar_side import LidarsKnown, LidarState
from coec.runtime.worker.supervisor import Worker


class LidarEdges:
    """For the main thread.

    Attributes:
        trouble: why none is looked at, where that can be helped; None else.
    """

    def __init__(
        self, config: LidarEdgesConfig, intake: Intake, worker: Worker, budget: Budget, rig: RigKeeper
    ) -> None:
        self._period_s = config.period_s
        self._intake = intake
        self._worker = worker
        self._budget = budget
        self._rig = rig
        self._names: set[str] = set()
        self.trouble: Reason | None = None

    def grow(self, pairs: Iterable[PairConfig]) -> None:
        """These are all pairs now, and the rig knows them: look at every two of their LiDARs that it did not have.

        Raises:
            ConfigError: the rig of a pair cannot be built.
        """
        for lidars in planned(pairs, self._period_s):
            if lidars.edge.name in self._names:
                continue
            self._names.add(lidars.edge.name)
            why_not = lidars.why_not
            if why_not is None:
                LidarEdgeStream(lidars, self._period_s, self._intake, self._worker, self._budget, self._rig)
                continue
            self._rig.join_lidars(LidarsKnown(lidars.edge, LidarState.NOT_MEASURED, (why_not,)), lambda: True)
            if why_not is NOT_INSTALLED:
                self.trouble = why_not
