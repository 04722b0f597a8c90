"""The rig of a vehicle as a graph: its nodes are sensors, its edges are what can be measured between two sensors.

An edge `a <- b` measures T_a_b, which maps coordinates of b to those of a; a camera-LiDAR pair is the edge camera <-
LiDAR. Every sensor has a pose in the rig, T_sensor_rig. A sensor that moves by x (6,) about its own axes has
T_sensor_rig(x) = perturb(T_sensor_rig, x), so that to first order

    T_a_b moves by   ξ = x_a - Ad(T_a_b) · x_b        about the axes of a.

Only differences are measured: moving everything at once changes no edge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry import se3

MOST_SENSORS = 12
"""Eight cameras, three LiDARs and the vehicle itself. It is bounded because the equations that are solved are dense."""


_WAS = " before"
"""Suffix of a name. No configured name has a space in it."""


def was(name: str) -> str:
    """The name for a sensor, an edge or a link as it was before a move."""
    return name + _WAS


def whose(name: str) -> str:
    """The sensor, edge or link that a name stands for, whether as it was before a move or as it is now."""
    return name.removesuffix(_WAS)


class SensorKind(StrEnum):
    """What a node is. The vehicle's own frame, if something measures it, is a node that cannot move."""

    CAMERA = "camera"
    LIDAR = "lidar"
    VEHICLE = "vehicle"


@dataclass(frozen=True, slots=True)
class Sensor:
    """A node."""

    name: str
    kind: SensorKind


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A relation that can be measured: T_a_b (4, 4) as the vehicle was built. `name` is that of the pair."""

    name: str
    a: str
    b: str
    T_a_b: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class RigidLink:
    """Two sensors on one bar: T_a_b (4, 4) is known, and stays so to `sigma` (6,) about the axes of a (rad, m)."""

    name: str
    a: str
    b: str
    T_a_b: Matrix4
    sigma: NDArray[np.float64]


class KnownTransform(NamedTuple):
    """An edge or a link: the fields that both have."""

    name: str
    a: str
    b: str
    T_a_b: Matrix4


@dataclass(frozen=True, eq=False)
class RigGraph:
    """Sensors, edges and links, each in the order of their names, so that no decision depends on the order of input."""

    sensors: tuple[Sensor, ...]
    edges: tuple[Edge, ...]
    links: tuple[RigidLink, ...]

    @classmethod
    def of(cls, sensors: Sequence[Sensor], edges: Sequence[Edge], links: Sequence[RigidLink] = ()) -> RigGraph:
        """The graph.

        Raises:
            ValueError: too many sensors or none; a name twice; an edge to a missing sensor, or from a sensor to itself;
                a pose that is not rigid; a link whose standard deviations are not six positive numbers.
        """
        if not 1 <= len(sensors) <= MOST_SENSORS:
            raise ValueError(f"a rig has 1 to {MOST_SENSORS} sensors, got {len(sensors)}: leave some out of it")
        all_known = _known(edges, links)
        _once("sensors", [sensor.name for sensor in sensors])
        _once("edges and links", [known.name for known in all_known])
        names = {sensor.name for sensor in sensors}
        for known in all_known:
            if known.a == known.b or not {known.a, known.b} <= names:
                raise ValueError(
                    f"{known.name}: joins {known.a} and {known.b}, which are not two different sensors of the rig"
                )
            if not se3.is_rigid(known.T_a_b):
                raise ValueError(f"{known.name}: T_a_b must be a rigid transform (4, 4)")
        for link in links:
            if link.sigma.shape != (6,) or not (np.isfinite(link.sigma).all() and (link.sigma > 0.0).all()):
                raise ValueError(f"{link.name}: sigma must be six positive numbers, got {link.sigma.tolist()}")
        return cls(
            tuple(sorted(sensors, key=lambda sensor: sensor.name)),
            tuple(sorted(edges, key=lambda edge: edge.name)),
            tuple(sorted(links, key=lambda link: link.name)),
        )

    @cached_property
    def place(self) -> Mapping[str, int]:
        """The number of each sensor, by name."""
        return {sensor.name: number for number, sensor in enumerate(self.sensors)}

    @cached_property
    def edge(self) -> Mapping[str, Edge]:
        """By name."""
        return {edge.name: edge for edge in self.edges}

    @cached_property
    def known(self) -> tuple[KnownTransform, ...]:
        """Edges, then links."""
        return _known(self.edges, self.links)

    @cached_property
    def poses(self) -> tuple[Matrix4, ...]:
        """T_sensor_rig (4, 4) of each sensor as the vehicle was built. The first sensor is the origin, and so is the
        first sensor of every part that no edge or link joins to it."""
        placed: dict[str, Matrix4] = {}
        for sensor in self.sensors:
            if sensor.name not in placed:
                placed |= self.joined_to(sensor.name)
        return tuple(placed[sensor.name] for sensor in self.sensors)

    @cached_property
    def of_lidars(self) -> frozenset[str]:
        """Names of the edges between two LiDARs, which no pair serves."""
        kinds = {sensor.name: sensor.kind for sensor in self.sensors}
        return frozenset(edge.name for edge in self.edges if kinds[edge.a] is kinds[edge.b] is SensorKind.LIDAR)

    def joined_to(self, origin: str) -> Mapping[str, Matrix4]:
        """T_sensor_origin (4, 4) as the vehicle was built, of each sensor that edges or links join to `origin`, by
        name."""
        placed: dict[str, Matrix4] = {origin: np.eye(4)}
        reached = [origin]
        for name in reached:  # grows as it goes: breadth first
            for known in self.known:
                if known.b == name and known.a not in placed:
                    placed[known.a] = np.asarray(known.T_a_b @ placed[name])
                    reached.append(known.a)
                elif known.a == name and known.b not in placed:
                    placed[known.b] = np.asarray(se3.inverse(known.T_a_b) @ placed[name])
                    reached.append(known.b)
        return placed

    def loop_through(self, closing: str, among: Sequence[str]) -> tuple[str, ...] | None:
        """The shortest loop through the edge or link `closing` that runs along those named in `among`: their names,
        `closing` first. None if there is none."""
        by_name = {known.name: known for known in self.known}
        first = by_name[closing]
        others = [by_name[name] for name in sorted(among) if name != closing]
        predecessor: dict[str, tuple[str, str]] = {first.b: ("", "")}
        reached = [first.b]
        for name in reached:
            for known in others:
                for here, there in ((known.a, known.b), (known.b, known.a)):
                    if here == name and there not in predecessor:
                        predecessor[there] = (name, known.name)
                        reached.append(there)
        if first.a not in predecessor:
            return None
        path, name = [], first.a
        while name != first.b:
            name, by = predecessor[name]
            path.append(by)
        return (closing, *path)


def _known(edges: Sequence[Edge], links: Sequence[RigidLink]) -> tuple[KnownTransform, ...]:
    return (
        *(KnownTransform(edge.name, edge.a, edge.b, edge.T_a_b) for edge in edges),
        *(KnownTransform(link.name, link.a, link.b, link.T_a_b) for link in links),
    )


def _once(what: str, names: Sequence[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{what} of a rig need names of their own; duplicates: {', '.join(twice)}")
