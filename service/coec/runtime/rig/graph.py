"""The rig of a vehicle as a graph, from the configuration of its pairs: sensors are nodes, pairs are edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import radians

import numpy as np

from coec.calibration.rig.types import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.types import Matrix4
from coec.config import LinkConfig, PairConfig


def graph_of(
    pairs: Mapping[str, tuple[PairConfig, Matrix4]], links: Sequence[LinkConfig], of_lidars: Sequence[Edge] = ()
) -> RigGraph:
    """The graph of pairs by name, each with its nominal calibration (4, 4), and of edges between their LiDARs. Edges
    and links of sensors that no pair has yet are left out.

    Raises:
        ValueError: there are more sensors than a rig may have.
    """
    sensors: dict[str, Sensor] = {}
    edges = []
    for name, (pair, T_camera_lidar) in pairs.items():
        camera, lidar = sensors_of(pair)
        sensors |= {camera: Sensor(camera, SensorKind.CAMERA), lidar: Sensor(lidar, SensorKind.LIDAR)}
        edges.append(Edge(name, camera, lidar, T_camera_lidar))
    edges += [edge for edge in of_lidars if {edge.a, edge.b} <= set(sensors)]
    rigid = [_link(link) for link in links]
    return RigGraph.of(list(sensors.values()), edges, [link for link in rigid if {link.a, link.b} <= set(sensors)])


def sensors_of(pair: PairConfig) -> tuple[str, str]:
    """Names of a pair's camera and LiDAR; they are the same in every pair that shares the sensor."""
    camera, lidar = pair.camera.sensor, pair.lidar.sensor
    return camera, f"{lidar} (LiDAR)" if lidar == camera else lidar


def _link(link: LinkConfig) -> RigidLink:
    a, b = link.ends
    sigma = np.array([radians(link.sigma_deg)] * 3 + [link.sigma_m] * 3)
    return RigidLink(f"link {a} {b}", a, b, np.array(link.T_a_b), sigma)
