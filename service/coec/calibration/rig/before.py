"""What was known before some sensors moved, as far as it is true after it.

A knocked LiDAR leaves the cameras where they were to one another, and of that all that was known before is worth as
much as ever. A sensor that moved is two nodes of the graph therefore: where it was, and where it is. What was known of
its pairs joins the first of these to the sensors that stood still; windows of since then join the second. Between the
two stands nothing, so the move is told by all of its pairs together, and loops close that did not: each pair has to
tell the same one.

What was known is less sure now than it was: mounts creep with time, and a knock shakes the others, too. What the scenes
of that time had in common is noise to the scenes of this one; how a lens is displaced lasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians

import numpy as np

from coec.calibration.rig.system import LASTING
from coec.calibration.rig.types import Edge, Link, RigGraph, Sensor, was
from coec.calibration.tracker import NS_PER_H, Measurement, creep_sigma
from coec.config import TrackerConfig

SHAKEN = np.array([radians(0.02)] * 3 + [0.003] * 3)
"""(6,) standard deviation by which a knock shifts what lies between two sensors of which it moves neither (rad, m).
Chosen: a third of what a window tells; a mount that is shifted by more was knocked itself, and the loops tell."""

CREEP = creep_sigma(TrackerConfig())
"""(6,) of a mount in an hour (rad, m): as pairs have it unless they are told otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """What was known.

    Attributes:
        sensors: that moved since.
        edges: of each that ends at one of them and was known, by name.
    """

    sensors: tuple[str, ...]
    edges: Mapping[str, Measurement]

    @classmethod
    def of(
        cls, sensors: tuple[str, ...], known: Mapping[str, Sequence[Measurement]], right_ns: int, stamp_ns: int
    ) -> Before:
        """By what was known of each edge at several times, the oldest first, in so far as it is of up to `right_ns`,
        when nothing had moved; as sure as it is at `stamp_ns`, when these sensors had."""
        right = {name: [one for one in of if one.stamp_ns <= right_ns] for name, of in known.items()}
        return cls(sensors, {name: remembered(of[-1], stamp_ns) for name, of in right.items() if of})

    @property
    def measured(self) -> Mapping[str, Measurement]:
        """By the names of the graph's other edges."""
        return {was(name): known for name, known in self.edges.items()}

    def joined(self, graph: RigGraph) -> RigGraph:
        """The graph with the sensors that moved as two nodes each, and what was known as edges of their own. Links
        between sensors of one bar held before as they do now."""
        old = {name: was(name) if name in self.sensors else name for name in graph.place}
        sensors = [Sensor(was(sensor.name), sensor.kind) for sensor in graph.sensors if sensor.name in self.sensors]
        edges = [
            Edge(was(edge.name), old[edge.a], old[edge.b], edge.T_a_b)
            for edge in graph.edges
            if edge.name in self.edges
        ]
        links = [
            Link(was(link.name), old[link.a], old[link.b], link.T_a_b, link.sigma)
            for link in graph.links
            if {link.a, link.b} & set(self.sensors)
        ]
        # No sensor is new: what bounds their number bounds these.
        return RigGraph(
            tuple(sorted((*graph.sensors, *sensors), key=lambda sensor: sensor.name)),
            tuple(sorted((*graph.edges, *edges), key=lambda edge: edge.name)),
            tuple(sorted((*graph.links, *links), key=lambda link: link.name)),
        )


def remembered(known: Measurement, stamp_ns: int) -> Measurement:
    """What was known of a pair as of its own stamp, as sure as it is at another, `stamp_ns`, on which a knock lies in
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
