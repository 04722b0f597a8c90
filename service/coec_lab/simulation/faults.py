"""What goes wrong on a drive, and when: one class per kind of fault, and the words that order a fault.

`KIND:BEGIN[-END][:KEY=VALUE,...]`, seconds from the start of the drive; without an end, to the end of the drive.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.errors import UsageError
from coec.geometry.se3 import perturb


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that is wrong from `begin_s` until `end_s`, seconds from the start of the drive."""

    begin_s: float
    end_s: float

    def active(self, time_s: float) -> bool:
        """Whether the fault is present at this time."""
        return self.begin_s <= time_s < self.end_s


F = TypeVar("F", bound=Fault)


@dataclass(frozen=True, slots=True)
class _Shift(Fault):
    """A change of the mount: T_camera_lidar becomes exp(ξ)·T_camera_lidar. Degrees and metres, camera axes."""

    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0
    tx: float = 0.0
    ty: float = 0.0
    tz: float = 0.0

    def xi(self) -> NDArray[np.float64]:
        """(6,) radians and metres."""
        return np.array([*np.deg2rad([self.rx, self.ry, self.rz]), self.tx, self.ty, self.tz])


@dataclass(frozen=True, slots=True)
class StepFault(_Shift):
    """The mount is knocked at once, and returns at the end."""


@dataclass(frozen=True, slots=True)
class DriftFault(_Shift):
    """The mount creeps evenly from begin to end, and then stays."""


@dataclass(frozen=True, slots=True)
class Swing(_Shift):
    """The mount is loose: it swings evenly to and fro by the shift about its pose, and is tight again at the end."""

    period_s: float = 2.0

    def phase(self, time_s: float) -> float:
        """The share of the shift at a time, -1 to 1."""
        return math.sin(2 * math.pi * (time_s - self.begin_s) / self.period_s)


@dataclass(frozen=True, slots=True)
class Dirt(Fault):
    """Blotches on the lens over this share of the picture."""

    share: float = 0.25


@dataclass(frozen=True, slots=True)
class Dark(Fault):
    """Only this share of the light is left, and the gain of the camera is at its limit."""

    light: float = 0.02


@dataclass(frozen=True, slots=True)
class Frozen(Fault):
    """The camera repeats its last picture with fresh stamps."""


@dataclass(frozen=True, slots=True)
class LidarFrozen(Fault):
    """The LiDAR repeats its last sweep with fresh stamps."""


@dataclass(frozen=True, slots=True)
class Beams(Fault):
    """This share of the beams is dead."""

    share: float = 0.5


@dataclass(frozen=True, slots=True)
class NoEgo(Fault):
    """No ego-motion is sent."""


@dataclass(frozen=True, slots=True)
class ZeroEgo(Fault):
    """The odometer reports that the vehicle stands, whatever it does."""


@dataclass(frozen=True, slots=True)
class StampOffset(Fault):
    """The stamps of the camera are late by this many seconds (early if negative)."""

    seconds: float = 0.05


@dataclass(frozen=True, slots=True)
class Loss(Fault):
    """This share of the messages of every sensor is lost on the way."""

    share: float = 0.3


@dataclass(frozen=True, slots=True)
class Tunnel(Fault):
    """The vehicle is in a tunnel: bare walls and a ceiling near, dim lamps."""


@dataclass(frozen=True, slots=True)
class OpenRoad(Fault):
    """Nothing stands or drives within reach of the LiDAR: a road, a meadow, the horizon."""


@dataclass(frozen=True, slots=True)
class Night(Fault):
    """The headlights are the only light; the camera exposes longer and amplifies more, which adds blur and noise."""


@dataclass(frozen=True, slots=True)
class Rain(Fault):
    """Rain, millimetres an hour: hazy air, drops on the lens and before the LiDAR, weaker echoes."""

    mmph: float = 20.0


@dataclass(frozen=True, slots=True)
class LowSun(Fault):
    """The sun stands low ahead of the vehicle, and scatters in the lens."""


@dataclass(frozen=True, slots=True)
class OffsetDrift(Fault):
    """The clock of the camera creeps: from begin to end its stamps get evenly later, up to so many seconds, and then
    stay so."""

    seconds: float = 0.05


KINDS: dict[str, type[Fault]] = {
    "step": StepFault,
    "drift": DriftFault,
    "swing": Swing,
    "dirt": Dirt,
    "dark": Dark,
    "frozen": Frozen,
    "lidar_frozen": LidarFrozen,
    "beams": Beams,
    "no-ego": NoEgo,
    "zero-ego": ZeroEgo,
    "offset": StampOffset,
    "loss": Loss,
    "tunnel": Tunnel,
    "open_road": OpenRoad,
    "night": Night,
    "rain": Rain,
    "low_sun": LowSun,
    "offset_drift": OffsetDrift,
}
CREEPING = ("drift", "offset_drift")
"""Kinds that grow from begin to end."""
FORMS = (
    "step:30:rx=3,tz=0.1 | drift:30-90:ry=2 | swing:30-90:rx=1,period_s=2 | dirt:30-60:share=0.3 | "
    "dark:30-60:light=0.02 | frozen:30-60 | lidar_frozen:30-60 | beams:30-60:share=0.5 | no-ego:30-60 | "
    "zero-ego:30-60 | offset:30-60:seconds=0.05 | loss:30-60:share=0.3 | "
    "offset_drift:10-60:seconds=0.05 | tunnel:20-35 | open_road:20-50 | night:20-60 | rain:20-60:mmph=20 | "
    "low_sun:20-60"
)
"""An example of each kind, for help and errors."""


HARDEST_RAIN_MMPH = 150.0
"""A cloudburst."""

LEAST_PERIOD_S = 0.01
"""Of a swing: a mount that moves faster blurs every picture, which is not drawn."""


def parse_fault(text: str) -> Fault:
    """A fault from its words.

    Raises:
        UsageError: the words are wrong; the message says how, and what to write.
    """
    kind, _, rest = text.partition(":")
    span, _, settings = rest.partition(":")
    if kind not in KINDS:
        raise UsageError(f"unknown fault {kind!r} in {text!r}; write one of {FORMS}")
    begin, dash, end = span.partition("-")
    begin_s = _number(text, "begin", begin)
    end_s = _number(text, "end", end) if dash else math.inf
    if not 0 <= begin_s < end_s:
        raise UsageError(f"fault {text!r}: it must begin at 0 s or later and end after that; write for example {FORMS}")
    if kind in CREEPING and math.isinf(end_s):
        raise UsageError(f"fault {text!r}: {kind} needs an end: write for example drift:30-90:ry=2")
    known = [field.name for field in fields(KINDS[kind])][2:]
    values: dict[str, float] = {}
    for setting in filter(None, settings.split(",")):
        key, _, value = setting.partition("=")
        if key not in known:
            takes = f"it takes {', '.join(known)}" if known else "it takes no settings"
            raise UsageError(f"fault {text!r}: unknown setting {key!r}; {takes}. Write for example {FORMS}")
        values[key] = _number(text, key, value)
    for key in ("share", "light"):
        if not 0 <= values.get(key, 0.0) <= 1:
            raise UsageError(f"fault {text!r}: {key} must lie between 0 and 1")
    if not 0 <= values.get("mmph", 0.0) <= HARDEST_RAIN_MMPH:
        raise UsageError(f"fault {text!r}: mmph must lie between 0 and {HARDEST_RAIN_MMPH:g}")
    if values.get("period_s", LEAST_PERIOD_S) < LEAST_PERIOD_S:
        raise UsageError(f"fault {text!r}: period_s must be {LEAST_PERIOD_S:g} or more")
    return KINDS[kind](begin_s, end_s, **values)


@dataclass(frozen=True, slots=True)
class SensorFault:
    """A fault of one sensor of a rig; with `sensor` None, of the surroundings or of all sensors alike."""

    sensor: str | None
    fault: Fault


OF_ALL: tuple[type[Fault], ...] = (NoEgo, ZeroEgo, Loss, Tunnel, OpenRoad, Night, Rain, LowSun)
"""Faults that need no sensor."""
OF_CAMERAS: tuple[type[Fault], ...] = (StepFault, DriftFault, Swing, Dirt, Dark, Frozen, StampOffset, OffsetDrift, Loss)
OF_LIDARS: tuple[type[Fault], ...] = (StepFault, DriftFault, Swing, LidarFrozen, Beams, Loss)


def parse_sensor_fault(text: str, cameras: Collection[str], lidars: Collection[str]) -> SensorFault:
    """A fault of a rig from its words, `[SENSOR:]KIND:BEGIN...`. A step turns a sensor about, and shifts it along, the
    sensor's own axes.

    Raises:
        UsageError: the words are wrong; the message says how, and what to write.
    """
    first, _, rest = text.partition(":")
    if first in cameras or first in lidars:
        fault = parse_fault(rest)
        if not isinstance(fault, OF_CAMERAS if first in cameras else OF_LIDARS):
            kind = "camera" if first in cameras else "LiDAR"
            raise UsageError(f"fault {text!r}: {rest.partition(':')[0]} is no fault of a {kind}")
        return SensorFault(first, fault)
    sensors = ", ".join((*cameras, *lidars))
    if first not in KINDS:
        raise UsageError(
            f"fault {text!r}: there is no sensor and no fault {first!r}; write SENSOR:FAULT, for example "
            f"{next(iter(cameras))}:step:40:ry=1, with one of the sensors {sensors} and the faults {FORMS}"
        )
    fault = parse_fault(text)
    if not isinstance(fault, OF_ALL):
        raise UsageError(f"fault {text!r}: of which sensor? Write SENSOR:{text} with one of {sensors}")
    return SensorFault(None, fault)


def _number(text: str, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UsageError(f"fault {text!r}: {name} must be a number, not {value!r}; write for example {FORMS}")
    return number


def now(faults: Iterable[Fault], kind: type[F], time_s: float) -> Iterator[F]:
    """The faults of a kind that are present at a time."""
    return (fault for fault in faults if isinstance(fault, kind) and fault.active(time_s))


def shifted(T_camera_lidar: NDArray[np.float64], faults: tuple[Fault, ...], time_s: float) -> NDArray[np.float64]:
    """(4, 4): the extrinsic after all steps, drifts and swings up to a time, in their order."""
    result = T_camera_lidar
    for fault in faults:
        if isinstance(fault, DriftFault):
            share = _share(fault, time_s)
            result = perturb(result, share * fault.xi()) if share > 0 else result
        elif isinstance(fault, StepFault) and fault.active(time_s):
            result = perturb(result, fault.xi())
        elif isinstance(fault, Swing) and fault.active(time_s):
            result = perturb(result, fault.phase(time_s) * fault.xi())
    return result


def late_s(faults: tuple[Fault, ...], time_s: float) -> float:
    """How late the stamp of a camera frame is that is taken at a time, seconds."""
    total = 0.0
    for fault in faults:
        if isinstance(fault, StampOffset) and fault.active(time_s):
            total += fault.seconds
        elif isinstance(fault, OffsetDrift):
            total += fault.seconds * _share(fault, time_s)
    return total


def _share(fault: Fault, time_s: float) -> float:
    """How far a creeping fault has grown, 0 to 1."""
    return min(max((time_s - fault.begin_s) / (fault.end_s - fault.begin_s), 0.0), 1.0)
