"""What was known before some sensors moved and is still true after the move.

A knocked LiDAR leaves the cameras where they were to one another, so all that was known about that still holds.
Therefore a sensor that moved is two nodes of the graph: where it was, and where it is. What was known of its pairs
joins the first node to the sensors that stood still; windows from after the move join the second. Nothing joins the two
nodes. So all pairs of the sensor determine the move together, and loops close that did not before: every pair has to
show the same move.

What was known is less certain than it was, because mounts creep with time and a knock shakes the other mounts too.
Errors that the scenes of that time had in common are noise beside the scenes of now; a displaced lens stays displaced.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians

import numpy as np

from coec.calibration.rig.system import LASTING
from coec.calibration.rig.types import Edge, RigGraph, RigidLink, Sensor, was
from coec.calibration.tracker import NS_PER_H, Measurement, creep_sigma
from coec.config import TrackerConfig

SHAKEN = np.array([radians(0.02)] * 3 + [0.003] * 3)
"""(6,) standard deviation by which a knock changes the pose between two sensors neither of which it moves (rad, m).
Chosen: a third of the uncertainty of a window. A mount that shifts by more was itself knocked, which the loops show."""

CREEP = creep_sigma(TrackerConfig())
"""(6,) standard deviation of the creep of a mount in an hour (rad, m): the default of the pairs."""


@dataclass(frozen=True, slots=True, eq=False)
class PreMoveKnowledge:
    """What was known before a move.

    Attributes:
        sensors: those that moved since.
        edges: what was known of each edge that ends at one of them, by name.
    """

    sensors: tuple[str, ...]
    edges: Mapping[str, Measurement]

    @classmethod
    def of(
        cls, sensors: tuple[str, ...], known: Mapping[str, Sequence[Measurement]], right_ns: int, stamp_ns: int
    ) -> PreMoveKnowledge:
        """From what was known of each edge at several times, oldest first: the latest up to `right_ns`, when nothing
        had moved yet, with the uncertainty that it has at `stamp_ns`, when these sensors had moved."""
        right = {name: [one for one in of if one.stamp_ns <= right_ns] for name, of in known.items()}
        return cls(sensors, {name: remembered(of[-1], stamp_ns) for name, of in right.items() if of})

    @property
    def measured(self) -> Mapping[str, Measurement]:
        """What was known, by the names that `joined` gives its edges."""
        return {was(name): known for name, known in self.edges.items()}

    def joined(self, graph: RigGraph) -> RigGraph:
        """The graph with two nodes for each sensor that moved, and with extra edges for what was known. Links at those
        sensors are doubled too, because a bar held before the move as it does now."""
        old = {name: was(name) if name in self.sensors else name for name in graph.place}
        sensors = [Sensor(was(sensor.name), sensor.kind) for sensor in graph.sensors if sensor.name in self.sensors]
        edges = [
            Edge(was(edge.name), old[edge.a], old[edge.b], edge.T_a_b)
            for edge in graph.edges
            if edge.name in self.edges
        ]
        links = [
            RigidLink(was(link.name), old[link.a], old[link.b], link.T_a_b, link.sigma)
            for link in graph.links
            if {link.a, link.b} & set(self.sensors)
        ]
        # No sensor is new: the limit on the number of sensors bounds these nodes, too.
        return RigGraph(
            tuple(sorted((*graph.sensors, *sensors), key=lambda sensor: sensor.name)),
            tuple(sorted((*graph.edges, *edges), key=lambda edge: edge.name)),
            tuple(sorted((*graph.links, *links), key=lambda link: link.name)),
        )


def remembered(known: Measurement, stamp_ns: int) -> Measurement:
    """What was known of a pair at its own stamp, with the uncertainty that it has at `stamp_ns`, after a knock in
    between."""
    hours = max(stamp_ns - known.stamp_ns, 0) / NS_PER_H
    uncertainty = known.uncertainty
    noise = uncertainty.noise + np.diag(SHAKEN**2 + hours * CREEP**2)
    lasting = {}
    for name in sorted(uncertainty.systematic):
        shift = uncertainty.systematic[name]
        if name in LASTING:
            lasting[name] = shift
        else:
            noise = noise + shift[:, None] * shift
    return replace(known, uncertainty=replace(uncertainty, noise=noise, systematic=lasting))
