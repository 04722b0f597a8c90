"""What several commands share: options, what these stand for (a calibration, a service, a pair), and the end by a
signal.

Each option is declared once, here or in the module of its only command; the options of a calibration are made from
their list, `coec.calibration_options`. Every command imports this module, so it imports nothing heavy at its top.
"""

from __future__ import annotations

import inspect
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from coec.calibration_options import Entry, entries
from coec.errors import ExitCode, UsageError
from coec.reports import console

if TYPE_CHECKING:
    from coec.calibration.types import Mistake, Rig
    from coec.config import Config, PairConfig
    from coec.io.zenoh.command_auth import Credentials
    from coec.io.zenoh.query_client import RouterAddress


def suggesting(values: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """A completion for an option: the values that begin with what is typed."""

    def complete(incomplete: str) -> list[str]:
        return [value for value in values() if value.startswith(incomplete)]

    return complete


def _option(entry: Entry) -> Any:
    """The option of the command line for an entry of the list of calibration options."""
    flag = entry.flag
    suggestions = None if flag.suggestions is tuple else suggesting(flag.suggestions)
    return typer.Option(
        *([flag.name] if flag.name else [f"--{entry.name.replace('_', '-')}"] if entry.annotation is bool else []),
        help=entry.text,
        metavar=flag.metavar,
        min=flag.minimum,
        show_default=flag.shown or True,
        autocompletion=suggestions,
    )


SOURCE_HELP = (
    "a recorded window or ROS 2 bag (.mcap), kitti360:ROOT?camera=image_00, kitti-raw:ROOT?..., a folder or "
    "dataset.yaml, sim:seed=1&seconds=60"
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output, nothing else.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite existing files.")]
Fix = Annotated[
    bool,
    typer.Option(
        "--fix",
        help="If a mistake in a dataset.yaml is found, write dataset.fixed.yaml without it, next to it, and exit 1.",
    ),
]
Source = Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)]
ConfigFile = Annotated[
    Path,
    typer.Option(
        "--config",
        help="Configuration of the daemon (YAML).",
        metavar="FILE",
        show_default=False,
        readable=False,  # whoever reads it says what is wrong, and ends with 78
    ),
]
DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
"""The same as in `config`, which takes too long to import for a help text."""

Connect = Annotated[
    str | None, typer.Option(help="Zenoh endpoint of the router.", metavar="ENDPOINT", show_default=DEFAULT_CONNECT)
]

Jobs = Annotated[
    int | None, typer.Option(help="Number of processes, of one core and 1 GB each.", min=1, show_default="the cores")
]
"""Option of commands that draw many drives."""

DegreesOfFreedom = Literal["3", "6"]
"""Degrees of freedom of a search: rotation only, or translation too."""

_CALIBRATION = {name: _option(entry) for name, entry in entries().items()}

Depth = Annotated[str | None, _CALIBRATION["depth"]]
Objective = Annotated[str | None, _CALIBRATION["objective"]]
Dof = Annotated[DegreesOfFreedom | None, _CALIBRATION["dof"]]
CameraModel = Annotated[str | None, _CALIBRATION["camera_model"]]
Frames = Annotated[int | None, _CALIBRATION["frames"]]


def with_calibration_options(options: type) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Adds an option for every entry of a list of calibration options to a command that takes `**options`.

    The options stand behind the arguments of the command. An option that the command declares itself stays as it is.
    What is given on the command line is passed on with the types of the list; what is not given is left out.
    """
    listed = entries(options)

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        declared = inspect.signature(command, eval_str=True)
        own = [each for each in declared.parameters.values() if each.kind is not each.VAR_KEYWORD]
        added = {name: entry for name, entry in listed.items() if name not in declared.parameters}

        @wraps(command)
        def run(**given: Any) -> int:
            typed = {name: given.pop(name) for name in added}
            values = {name: _value(added[name], value) for name, value in typed.items()}
            return command(**given, **{name: value for name, value in values.items() if value is not None})

        arguments = [each for each in own if each.default is each.empty]
        rest = [each for each in own if each.default is not each.empty]
        parameters = [*arguments, *map(_parameter, added.values()), *rest]
        run.__signature__ = declared.replace(  # type: ignore[attr-defined]
            parameters=[each.replace(kind=each.KEYWORD_ONLY) for each in parameters]
        )
        return run

    return decorate


def _parameter(entry: Entry) -> inspect.Parameter:
    kind = entry.flag.typed or entry.annotation
    is_switch = kind is bool
    return inspect.Parameter(
        entry.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=False if is_switch else None,
        annotation=Annotated[kind if is_switch else kind | None, _CALIBRATION[entry.name]],
    )


def _value(entry: Entry, given: Any) -> Any:
    """The value of an option from what was typed; None: not given."""
    if given is None or given is False:
        return None
    return given if entry.flag.value is None else entry.flag.value(given)


# Options about a running service.
ServiceConfig = Annotated[
    Path | None,
    typer.Option(
        "--config", help="Configuration of the service; names the vehicle, the prefix and the router.", metavar="FILE"
    ),
]
Vehicle = Annotated[str | None, typer.Option(help="Name of the vehicle.", show_default="vehicle")]
Prefix = Annotated[str | None, typer.Option(help="Prefix of all keys.", show_default="coec")]
SessionFile = Annotated[
    Path | None,
    typer.Option(
        "--zenoh",
        help="Zenoh configuration of the session (JSON5): endpoint, certificate.",
        metavar="FILE",
        readable=False,  # as `ConfigFile`
    ),
]
RouterTimeout = Annotated[float, typer.Option("--timeout", help="Seconds to wait for the router.", min=0.01)]


def show_correction(manifest: Path, mistake: Mistake, rig: Rig) -> None:
    """Writes a manifest without a mistake, and reports on standard error what changed.

    Raises:
        OutputError: it cannot be written.
    """
    from coec.io.recordings.manifest import write_corrected

    correction = write_corrected(manifest, mistake, rig.camera, rig.T_camera_lidar_nominal)
    console.say(f"coec: written {correction.path}: {'; '.join(correction.changes)}")


@dataclass(frozen=True, slots=True)
class ServiceAddress:
    """The service of a vehicle, and the way to its router. `credentials` authenticate commands; None: the session has
    none."""

    vehicle: str
    prefix: str
    way: RouterAddress
    credentials: Credentials | None = None


def service_address(
    config: Path | None,
    vehicle: str | None,
    prefix: str | None,
    connect: str | None,
    zenoh_file: Path | None = None,
) -> ServiceAddress:
    """The service of a configuration, or one with the default names; other given arguments take precedence.

    Raises:
        ConfigError: the configuration, or the Zenoh configuration, cannot be read.
    """
    from coec.config import Config, ZenohConfig, load_config
    from coec.io.zenoh.query_client import RouterAddress
    from coec.io.zenoh.session import connected_of, credentials_in, read_settings

    if config is not None:
        loaded = load_config(config)
        usual_vehicle, usual_prefix, zenoh_config = loaded.vehicle, loaded.prefix, loaded.zenoh
    else:
        fields = Config.model_fields
        usual_vehicle, usual_prefix, zenoh_config = fields["vehicle"].default, fields["prefix"].default, ZenohConfig()
    file = zenoh_file or zenoh_config.file
    settings = None if file is None else read_settings(file)
    endpoints = () if settings is None else connected_of(settings)
    return ServiceAddress(
        usual_vehicle if vehicle is None else vehicle,
        usual_prefix if prefix is None else prefix,
        RouterAddress((endpoints or zenoh_config.router) if connect is None else (connect,), file),
        None if settings is None else credentials_in(settings),
    )


def pair_named(config: Config, name: str | None) -> PairConfig:
    """The pair of this name, or with None the only one.

    Raises:
        UsageError: no pair has this name, there are several, or the pair is not discovered yet.
    """
    pairs = {pair.name: pair for pair in config.pairs}
    if name is None and len(pairs) == 1:
        return config.pairs[0]
    if name in {pair.name for pair in config.awaited} or (name is None and not pairs):
        raise UsageError("the pair is not complete: the service has not discovered what its configuration leaves out")
    if name is None or name not in pairs:
        raise UsageError(f"--pair: the configuration has the pairs {', '.join(pairs)}; name one of them")
    return pairs[name]


# Options about a simulated vehicle.
Seed = Annotated[int, typer.Option(help="Seed of the drive: the same seed gives the same bytes.", min=0)]
SimCamera = Annotated[
    str,
    typer.Option(
        help="fisheyeW (185°, W×W pixels), pinholeWxH (90° wide) or pinholeWxH@D (D degrees wide).", metavar="CAMERA"
    ),
]
SimScene = Annotated[str, typer.Option(help="street, highway, garage or room.", metavar="SCENE")]
SimSpeed = Annotated[
    float | None,
    typer.Option("--speed", help="Mean speed, m/s; 0 stands still. Default: as usual in the scene.", min=0, max=45),
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="KIND:BEGIN[-END][:KEY=VALUE,...], repeatable: step:30:rx=3, drift:30-90:ry=2, "
        "swing:30-90:rx=1,period_s=2, dirt, dark, frozen, lidar_frozen, beams, no-ego, zero-ego, offset, "
        "offset_drift:10-60:seconds=0.05, loss; poor stretches: tunnel:20-35, open_road:20-50, night:20-60, "
        "rain:20-60:mmph=20, low_sun:20-60.",
        metavar="FAULT",
    ),
]


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, so that a command can withdraw what it announced before it ends."""
    stop = threading.Event()

    def receive(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def success_on_sigterm() -> Iterator[None]:
    """Ends the process with success on SIGTERM while a service is loaded, before it handles signals itself. The first
    process of a container has no default for a signal: the kernel would drop it, and the engine would wait for nothing.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        sys.exit(ExitCode.SUCCESS)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
