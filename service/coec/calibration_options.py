"""The options of a calibration: the only list of them.

`coec.calibrate`, the methods `calibrate` of recordings and windows, and `coec.evaluate` take these keyword arguments.
The options of the commands `calibrate` and `evaluate` are made from it (`coec.cli.options`), and the reference pages
show its docstrings. A new option that sets a value of the configuration is one entry here. The help of a command is
read from the docstrings of the entries, so this module imports nothing heavy.
"""

# No `from __future__ import annotations`: the command line reads the annotations.

import ast
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, cast, get_origin

from coec.errors import UsageError

if TYPE_CHECKING:
    from coec.config import CalibrationConfig

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, how many of its parts are done, and how many it has (0: unknown)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Flag:
    """How the command line has an option. An option without a flag exists only in Python.

    Attributes:
        key: value of the calibration's configuration that the option sets, with dots: `search.dof`.
        name: name on the command line, where it is not `--` and the option's name with hyphens.
        typed: type on the command line, where it is not that of the option.
        value: the option's value for a given value of the type `typed`; None: not given.
        metavar, shown, minimum: placeholder, default in the help, and least number.
        suggestions: values that a shell suggests.
    """

    key: str | None = None
    name: str | None = None
    typed: Any = None
    value: Callable[[Any], Any] | None = None
    metavar: str | None = None
    shown: str | None = None
    minimum: int | None = None
    suggestions: Callable[[], Iterable[str]] = tuple


def _depth_models() -> Iterable[str]:
    from coec.io.depth.model_cards import built_in_cards

    return ("stereo", *built_in_cards())


class SolverOptions(TypedDict, total=False):
    """Keyword arguments of `coec.evaluate` and, with those of `CalibrationOptions`, of `coec.calibrate`. What is not
    given is as recorded, else the default."""

    depth: Annotated[
        str | PathLike[str] | None,
        Flag(key="depth.model", typed=str, metavar="MODEL", suggestions=_depth_models),
    ]
    """An ONNX file, a built-in name (`coec models`), or `stereo` for the depth maps of the recording. Default: the
    network that a recorded window names, else the one that comes with coec."""

    objective: Annotated[
        str | None, Flag(key="objective.kind", metavar="NAME", suggestions=lambda: ("fused", "mi", "intensity"))
    ]
    """Objective to maximise: fused (edges and depth), mi (the paper) or intensity."""

    dof: Annotated[int | None, Flag(key="search.dof", typed=Literal["3", "6"], value=int)]
    """Degrees of freedom: 3, rotation only, or 6, rotation and translation."""

    camera_model: Annotated[str | None, Flag(metavar="NAME", suggestions=lambda: ("double_sphere",))]
    """Fit this model to the camera and use it: double_sphere. Refused if it does not fit the lens."""

    frames: Annotated[int | None, Flag(shown="25", metavar="N", minimum=1)]
    """Use at most this many camera frames, evenly spaced."""

    motion_compensation: Annotated[
        bool | None,
        Flag(
            key="motion_compensation",
            name="--no-motion-compensation",
            typed=bool,
            value=lambda given: False if given else None,
        ),
    ]
    """Use the sweeps as they were recorded, without motion compensation (in Python: False)."""

    progress: Progress | None
    """Called with (stage, parts done, number of parts); the number is 0 while it is unknown."""


class CalibrationOptions(SolverOptions, total=False):
    """Keyword arguments of `coec.calibrate`, together with those of `SolverOptions`. What is not given is as recorded,
    else the default."""

    perturb: Annotated[str | Sequence[float] | None, Flag(typed=str, metavar="RX,RY,RZ[,TX,...]")]
    """Move the start away from the recording's calibration: degrees about the camera axes, then metres along them."""

    start: Annotated[Literal["recording", "none"] | None, Flag(shown="recording")]
    """Where the search starts: at the recording's calibration, or none: no initial guess, any rotation. With --dof 3
    the position of the camera in the LiDAR's frame stays that of the recording's calibration; with --dof 6 the camera
    may be anywhere within 3 m of the LiDAR."""

    time_offset: Annotated[bool, Flag()]
    """Also estimate the offset of the camera's clock, if turns of the vehicle make it observable."""

    configuration: "CalibrationConfig | None"
    """All settings that decide a result, in place of the recorded ones. The other options override it."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An option as a command line needs it: its name, annotation, flag and docstring."""

    name: str
    annotation: Any
    flag: Flag
    text: str


def entries(options: type = CalibrationOptions) -> Mapping[str, Entry]:
    """The options that have a flag, by name, in the order of the list."""
    hints: Mapping[str, Any] = options.__annotations__
    flags = {name: hint.__metadata__[0] for name, hint in hints.items() if get_origin(hint) is Annotated}
    texts = _docstrings()
    return {name: Entry(name, hints[name].__origin__, flag, texts[name]) for name, flag in flags.items()}


@cache
def _docstrings() -> Mapping[str, str]:
    """The docstring of every entry of this file, by name, on one line."""
    classes = [node for node in ast.parse(Path(__file__).read_text("utf-8")).body if isinstance(node, ast.ClassDef)]
    texts = {}
    for declared in classes:
        for entry, text in zip(declared.body, declared.body[1:], strict=False):
            match entry, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(docstring))):
                    texts[name] = " ".join(docstring.split())
    return texts


def checked(options: SolverOptions) -> SolverOptions:
    """The options, if the list has all of them.

    Raises:
        TypeError: an unknown option, as for every other function.
    """
    unknown = sorted(set(options) - set(CalibrationOptions.__annotations__))
    if unknown:
        known = ", ".join(CalibrationOptions.__annotations__)
        raise TypeError(f"calibrate() got an unexpected keyword argument {unknown[0]!r}; known are {known}")
    return options


def configuration_of(options: SolverOptions, recorded: "CalibrationConfig | None") -> "CalibrationConfig":
    """The recorded configuration, else the defaults, overridden by the options that set a value of it.

    Raises:
        UsageError: a value that does not exist.
    """
    from pydantic import ValidationError

    from coec.config import CalibrationConfig, describe

    values: dict[str, Any] = (recorded or CalibrationConfig()).model_dump()
    given = cast("Mapping[str, Any]", options)
    for name, entry in entries().items():
        if entry.flag.key is None or given.get(name) is None:
            continue
        *blocks, last = entry.flag.key.split(".")
        block = values
        for part in blocks:
            block = block[part]
        block[last] = fspath(given[name]) if isinstance(given[name], PathLike) else given[name]
    try:
        return CalibrationConfig.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"the options do not fit: {describe(error)}") from error
