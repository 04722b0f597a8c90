"""Plans which two LiDARs of a vehicle are looked at together, from the configuration of its pairs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coec.adapters.files.rig import rig_of
from coec.adapters.registration import nearest
from coec.calibration.lidar_to_lidar.types import LidarRig
from coec.calibration.rig.types import Edge
from coec.calibration.types import Matrix4, Reason, Rig
from coec.config import PairConfig
from coec.runtime.rig.graph import graph_of, sensors_of

MAX_LIDAR_PAIRS = 6
"""How many combinations of two LiDARs are looked at, in the order of the configuration: all those of four LiDARs. Each
holds some twenty sweeps."""

NOT_INSTALLED = Reason(
    "lidars_not_installed",
    "Not measured: the extra lidars is not installed. Add it (pip install 'coec[lidars]'), or set "
    "`lidar_edges.period_s: 0`.",
)
SWITCHED_OFF = Reason("switched_off", "Not measured: `lidar_edges.period_s` is 0.")
NO_EGO = Reason(
    "no_ego_motion",
    "Not measured: no `ego` is configured, and without ego-motion two sweeps of a moving vehicle are not of one "
    "instant.",
)
NOT_JOINED = Reason(
    "no_nominal_pose", "Not measured: no cameras and links join the two, so nothing tells where they were built."
)
TOO_MANY = Reason("too_many", f"Not measured: {MAX_LIDAR_PAIRS} pairs of LiDARs are looked at, and this is one more.")


@dataclass(frozen=True, slots=True, eq=False)
class LidarOfPair:
    """A LiDAR of a vehicle: its name, a pair that has it, and the rig of that pair."""

    name: str
    pair: PairConfig
    rig: Rig


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairPlan:
    """Two LiDARs.

    Attributes:
        edge: the edge between them, with the pose as built.
        why_not: why they are not looked at; None if they are.
    """

    edge: Edge
    a: LidarOfPair
    b: LidarOfPair
    why_not: Reason | None

    @property
    def rig(self) -> LidarRig:
        """The two LiDARs as input of a registration."""
        a, b = self.a, self.b
        return LidarRig(a.name, b.name, self.edge.T_a_b, a.rig.T_lidar_ego, a.rig.sweep, b.rig.sweep)


def plan_lidar_pairs(pairs: Iterable[PairConfig], period_s: float) -> tuple[LidarPairPlan, ...]:
    """Every two LiDARs of the pairs. The one that comes first in the configuration is a; if one LiDAR is larger, people
    name it first.

    Raises:
        ConfigError: the rig of a pair cannot be built.
    """
    rigs = {pair.name: (pair, rig_of(pair)) for pair in pairs}
    lidars: dict[str, LidarOfPair] = {}
    for pair, rig in rigs.values():
        name = sensors_of(pair)[1]
        lidars.setdefault(name, LidarOfPair(name, pair, rig))
    if len(lidars) < 2:
        return ()
    places = _places({name: (pair, rig.T_camera_lidar_nominal) for name, (pair, rig) in rigs.items()})
    plans: list[LidarPairPlan] = []
    for a, b in combinations(lidars.values(), 2):
        T_a_b = places.get(b.name, {}).get(a.name)
        edge = Edge(f"{a.name} to {b.name}", a.name, b.name, np.eye(4) if T_a_b is None else T_a_b)
        why_not = NOT_JOINED if T_a_b is None else _why_not(a, period_s)
        if why_not is None and sum(one.why_not is None for one in plans) >= MAX_LIDAR_PAIRS:
            why_not = TOO_MANY
        plans.append(LidarPairPlan(edge, a, b, why_not))
    return tuple(plans)


def _places(pairs: Mapping[str, tuple[PairConfig, Matrix4]]) -> dict[str, Mapping[str, Matrix4]]:
    """T_sensor_origin (4, 4) by origin and sensor, for sensors that are joined by pairs; empty if there are more
    sensors than a rig may have."""
    try:
        graph = graph_of(pairs, ())
    except ValueError:
        return {}
    return {sensor.name: graph.joined_to(sensor.name) for sensor in graph.sensors}


def _why_not(a: LidarOfPair, period_s: float) -> Reason | None:
    if period_s == 0.0:
        return SWITCHED_OFF
    if not nearest.installed():
        return NOT_INSTALLED
    return NO_EGO if a.pair.ego is None else None
