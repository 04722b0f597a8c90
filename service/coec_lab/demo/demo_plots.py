"""A plot of the demonstration as PNG bytes: a rig from above, with where its sensors sit and point, what its pairs
report, and which sensor has moved.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, isfinite, sin
from types import MappingProxyType

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyBboxPatch, Wedge

from coec.calibration.types import Matrix4
from coec_lab.experiments.plots import png, titled

SENSOR_COLOURS: Mapping[str, str] = MappingProxyType(
    {
        "calibrated": "tab:green",
        "camera_moved": "tab:red",
        "lidar_moved": "tab:red",
        "undecided": "orange",
        "unknown": "silver",
    }
)
"""Health of a sensor; any other state is drawn as `unknown`."""
MOVED = ("camera_moved", "lidar_moved")

CERTAIN_SIGMAS = 6.0
"""Colours of edges end here: a pair so many of its standard deviations from its nominal has surely moved."""
EDGES = "coolwarm"
LENGTH_M, WIDTH_M, BEHIND_M = 4.6, 1.9, 0.95
"""Length and width of the vehicle's outline, and how far it reaches behind the rear axle, its frame's origin."""
MARGIN_M = 1.3
FAN_M = {"camera": 1.1, "lidar": 0.75}
"""Radius of the fan of a field of view: it shows the direction, not the reach."""
LABEL_M, LABEL_SPACING_M, LINE_M = 0.42, 0.62, 0.26
"""Distance of a name from its sensor, least distance between names, and height of a line of text."""
TRIES = 16
"""Directions around its sensor that are tried for a name."""


@dataclass(frozen=True, slots=True, eq=False)
class PlottedSensor:
    """A sensor in the picture.

    Attributes:
        kind: `camera` or `lidar`.
        T_ego_sensor: (4, 4) pose in the vehicle (x forward, y left); a camera looks along its z, a LiDAR along its x.
        view_deg: width of its field of view; 360 for a turning LiDAR.
        state: its health, see `SENSOR_COLOURS`.
        probability: that it has moved; None where that is unknown.
        moved_deg: by how much it has moved, if it has.
    """

    name: str
    kind: str
    T_ego_sensor: Matrix4
    view_deg: float
    state: str
    probability: float | None = None
    moved_deg: float | None = None


@dataclass(frozen=True, slots=True)
class PlottedEdge:
    """What a pair of sensors says: it is `deg` ± `sigma_deg` from where it was."""

    a: str
    b: str
    deg: float
    sigma_deg: float

    @property
    def sigmas(self) -> float:
        """The evidence that something has moved; 0 where the pair cannot tell."""
        known = isfinite(self.deg) and isfinite(self.sigma_deg) and self.sigma_deg > 0.0
        return abs(self.deg) / self.sigma_deg if known else 0.0


def rig_from_above(sensors: Sequence[PlottedSensor], edges: Sequence[PlottedEdge], title: str) -> bytes:
    """The picture; ahead is up. An edge is the redder, the surer its pair is that something has moved. A sensor that
    has moved is marked.

    Raises:
        ValueError: an edge names a sensor that is missing; the message says which.
    """
    places = {sensor.name: _place(sensor) for sensor in sensors}
    if unknown := sorted({name for edge in edges for name in (edge.a, edge.b)} - set(places)):
        raise ValueError(f"edges of sensors that the picture does not have: {', '.join(unknown)}")
    figure = titled(title, 8.4, 9.2)
    axes = figure.subplots()
    _frame(axes, list(places.values()))
    colours = Normalize(0.0, CERTAIN_SIGMAS, clip=True)
    scale = ScalarMappable(colours, EDGES)
    for sensor in sensors:
        _plot_view(axes, sensor)
    for edge in sorted(edges, key=lambda edge: edge.sigmas):  # the surest edges lie on top
        (x, y), (x2, y2) = places[edge.a], places[edge.b]
        colour = colormaps[EDGES](float(colours(edge.sigmas)))
        axes.plot([x, x2], [y, y2], color=colour, linewidth=2.6, zorder=3, solid_capstyle="round")
    for sensor in sensors:
        _plot_sensor(axes, sensor)
    _plot_labels(axes, sensors, list(places.values()))
    figure.colorbar(scale, ax=axes, shrink=0.55, label="a pair's offset from its nominal, in its standard deviations")
    seen = [state for state in SENSOR_COLOURS if any(_state(sensor) == state for sensor in sensors)]
    handles = [_dot("o", SENSOR_COLOURS[state], state_text(state)) for state in seen]
    handles += [_dot("^", "white", "camera"), _dot("o", "white", "LiDAR")]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return png(figure)


def label_of(sensor: PlottedSensor) -> str:
    """The label beside a sensor."""
    lines = [sensor.name]
    if sensor.state in MOVED:
        by = "" if sensor.moved_deg is None else f" by {sensor.moved_deg:.2g}°"
        lines.append(f"moved{by}")
    elif sensor.state != "calibrated":
        lines.append(state_text(sensor.state))
    if sensor.probability is not None and (sensor.state != "calibrated" or sensor.probability >= 0.005):
        lines.append(percent(sensor.probability))
    return "\n".join(lines)


def state_text(state: str) -> str:
    """The state of a sensor in words."""
    return state.replace("_", " ").replace("lidar", "LiDAR")


def percent(probability: float) -> str:
    """A probability in percent, never as 100 % or 0 %, because it is not certain."""
    if probability > 0.99:
        return "> 99 %"
    return "< 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def _place(sensor: PlottedSensor) -> tuple[float, float]:
    """Place on the page: ahead (x of the vehicle) is up, left (y) is left."""
    return -float(sensor.T_ego_sensor[1, 3]), float(sensor.T_ego_sensor[0, 3])


def _heading_rad(sensor: PlottedSensor) -> float:
    """Direction on the page, counter-clockwise from the right."""
    ahead = sensor.T_ego_sensor[:3, 2 if sensor.kind == "camera" else 0]
    return atan2(float(ahead[0]), -float(ahead[1]))


def _state(sensor: PlottedSensor) -> str:
    return sensor.state if sensor.state in SENSOR_COLOURS else "unknown"


def _frame(axes: Axes, places: Sequence[tuple[float, float]]) -> None:
    """Draws the outline of the vehicle, and makes room for all sensors."""
    outline = FancyBboxPatch(
        (-WIDTH_M / 2 + 0.3, -BEHIND_M + 0.3), WIDTH_M - 0.6, LENGTH_M - 0.6, boxstyle="round,pad=0.3",
        facecolor="whitesmoke", edgecolor="grey", linewidth=1.2, zorder=0,
    )  # fmt: skip
    axes.add_patch(outline)
    axes.annotate(
        "", (0.0, LENGTH_M - BEHIND_M + 0.75), (0.0, LENGTH_M - BEHIND_M + 0.15),
        arrowprops={"arrowstyle": "->", "color": "grey", "linewidth": 1.5},
    )  # fmt: skip
    x, y = ([place[axis] for place in places] for axis in (0, 1))
    axes.set_xlim(min([-WIDTH_M / 2, *x]) - MARGIN_M, max([WIDTH_M / 2, *x]) + MARGIN_M)
    axes.set_ylim(min([-BEHIND_M, *y]) - 0.7, max([LENGTH_M - BEHIND_M, *y]) + 0.9)
    axes.set_aspect("equal")
    axes.set_xlabel("to the right, m")
    axes.set_ylabel("ahead of the rear axle, m")


def _plot_view(axes: Axes, sensor: PlottedSensor) -> None:
    heading_deg, half_deg = degrees(_heading_rad(sensor)), min(sensor.view_deg, 360.0) / 2
    fan = Wedge(
        _place(sensor), FAN_M.get(sensor.kind, 0.75), heading_deg - half_deg, heading_deg + half_deg,
        facecolor=SENSOR_COLOURS[_state(sensor)], alpha=0.13, linewidth=0, zorder=1,
    )  # fmt: skip
    axes.add_patch(fan)


def _plot_sensor(axes: Axes, sensor: PlottedSensor) -> None:
    x, y = _place(sensor)
    if sensor.state in MOVED:
        axes.add_patch(
            Circle((x, y), 0.21, fill=False, edgecolor=SENSOR_COLOURS[sensor.state], linewidth=2.5, zorder=5)
        )
    # A triangle that points to where the camera looks.
    marker = (3, 0, degrees(_heading_rad(sensor)) - 90.0) if sensor.kind == "camera" else "o"
    axes.plot(
        [x],
        [y],
        marker=marker,
        markersize=13.0,
        color=SENSOR_COLOURS[_state(sensor)],
        markeredgecolor="black",
        zorder=6,
    )


def _plot_labels(axes: Axes, sensors: Sequence[PlottedSensor], places: Sequence[tuple[float, float]]) -> None:
    """Draws names beside their sensors, in free places; the longest labels choose first."""
    taken = list(places)
    for number in sorted(range(len(sensors)), key=lambda number: -label_of(sensors[number]).count("\n")):
        label = label_of(sensors[number])
        at = _free(places[number], label, taken)
        taken.append(at)
        bold = "bold" if sensors[number].state in MOVED else "normal"
        axes.text(*at, label, ha="center", va="center", fontsize=10, fontweight=bold, zorder=7)


def _free(place: tuple[float, float], label: str, taken: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The place around a sensor at which its words are far enough from all others, outwards if possible."""
    distance = LABEL_M + LINE_M * label.count("\n") / 2
    best, room = place, -1.0
    outwards = atan2(place[1] - (LENGTH_M / 2 - BEHIND_M), place[0]) if place[0] else 0.0
    for step in range(TRIES):
        angle = outwards + 2 * np.pi * step / TRIES
        at = (place[0] + 1.3 * distance * cos(angle), place[1] + distance * sin(angle))
        separation = min(hypot(at[0] - x, at[1] - y) for x, y in taken)
        if separation > room + 1e-9 and room < LABEL_SPACING_M:
            best, room = at, separation
    return best


def _dot(marker: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], linestyle="", marker=marker, color=colour, markeredgecolor="black", markersize=9, label=label)
