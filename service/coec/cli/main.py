"""The frame of the command line: finds the command, runs it, and turns its outcome into an exit status.

A command is a function `module:function` with the parameters that Typer reads, whose docstring is its help and which
returns the exit status. This package names its commands in `BUILT_IN`; another package adds commands by entry points of
group `coec.commands`. Exit codes (CONTRACT, "Command line") are those of `coec.errors`. With `--json`, standard
output holds one JSON document and nothing else.
"""

from __future__ import annotations

import errno
import inspect
import json
import logging
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from importlib import import_module
from typing import Annotated, Any

import typer

from coec import __version__
from coec.cli.signals import no_interrupt_lost
from coec.errors import CoecError, ExitCode, UsageError
from coec.reports import plain_text
from coec.untrusted import json_printable

BUILT_IN = {
    "models": "coec.cli.models:app",
    "fleet": "coec.cli.fleet:app",
    "calibrate": "coec.cli.calibrate:calibrate",
    "commission": "coec.cli.commission:commission",
    "diagnose": "coec.cli.diagnose:diagnose",
    "run": "coec.cli.run:run",
    "check-config": "coec.cli.check_config:check_config",
    "doctor": "coec.cli.doctor:doctor",
    "play": "coec.cli.play:play",
    "query": "coec.cli.query:query",
    "watch": "coec.cli.watch:watch",
    "fetch": "coec.cli.fetch:fetch",
    "view": "coec.cli.view:view",
    "router": "coec.cli.router:router",
    "warmup": "coec.cli.warmup:warmup",
    "batch": "coec.cli.batch:batch",
    "replay": "coec.cli.replay:replay",
    "convert": "coec.cli.convert:convert",
    "sbom": "coec.cli.sbom:sbom",
    "check": "coec.cli.check:check",
    "lidars": "coec.cli.lidars:lidars",
    "export": "coec.cli.export:export",
}
"""Commands of this package in the order of the help text: a function, or a `typer.Typer` with subcommands."""

GROUP = "coec.commands"
"""Group of entry points by which another package adds commands: the name, with a dot before that of a subcommand
(`models.assess`), and `module:function` or, for a group of commands, `module:app`."""

DECIDING = ("numpy", "numba", "llvmlite", "onnxruntime", "opencv-python-headless", "nlopt", "eclipse-zenoh")
"""Distributions whose other versions may round, sample or order differently. Where two machines decide differently,
these may differ."""

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a write to standard output or to a temporary file that are no fault of coec."""


def application(arguments: Sequence[str]) -> typer.Typer:
    """The commands that a command line may need: the one that its first argument names, or all if it names none, for
    the help text or the error. Importing all takes some tens of milliseconds, so most calls import only one."""
    plain = plain_text.wants_plain(os.environ) or not plain_text.is_unicode(sys.stdout.encoding)
    app = typer.Typer(
        name="coec",
        no_args_is_help=True,
        rich_markup_mode=None if plain else "rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Continuous online extrinsic calibration of a camera and a LiDAR.",
    )
    app.callback(result_callback=_exit_with)(_coec)
    first = arguments[0] if arguments else ""
    is_built_in = first in BUILT_IN
    built_in = {first: BUILT_IN[first]} if is_built_in else BUILT_IN
    # Of the commands here, only groups get subcommands from other packages.
    others = {} if is_built_in and not BUILT_IN[first].endswith(":app") else _added_commands()
    if is_built_in or first in others:
        built_in = built_in if is_built_in else {}
        others = {name: load for name, load in others.items() if first in (name, name.partition(".")[0])}
    commands: dict[str, Any] = {}
    for name, target in built_in.items():
        commands[name] = _add(app, name, _load(target), None)
    for name in sorted(others, key=lambda name: "." in name):  # groups before what is added to them
        group, _, subcommand = name.rpartition(".")
        if not group:
            commands[name] = _add(app, name, others[name](), "Laboratory")
        elif group in commands:
            _add(commands[group], subcommand, others[name](), None)
    return app


def _load(target: str) -> Any:
    module, _, name = target.partition(":")
    return getattr(import_module(module), name)


def _added_commands() -> dict[str, Callable[[], Any]]:
    """What other packages add, by name: functions that load the commands."""
    from importlib.metadata import entry_points

    return {point.name: point.load for point in entry_points(group=GROUP)}


def _add(app: typer.Typer, name: str, command: Any, panel: str | None) -> typer.Typer | None:
    """Adds a command or group. Returns a group as it was added: a copy, to which subcommands may be added."""
    if not isinstance(command, typer.Typer):
        app.command(name, rich_help_panel=panel)(_evaluated(command))
        return None
    group = copy(command)
    group.registered_commands = [*command.registered_commands]
    app.add_typer(group, name=name, rich_help_panel=panel)
    return group


def _evaluated(command: Callable[..., int]) -> Callable[..., int]:
    """The command with its annotations as types. Of text Typer evaluates every annotation twice, which takes long."""

    def run(**given: Any) -> int:
        return command(**given)

    run.__doc__ = command.__doc__
    run.__signature__ = inspect.signature(command, eval_str=True)  # type: ignore[attr-defined]
    return run


def _exit_with(status: int | None, **_: object) -> None:
    """Makes the exit status of what the command returned."""
    raise typer.Exit(status or 0)


def versions() -> dict[str, str | None]:
    """The versions of this program and of what its decisions are computed with, by name; None: not installed."""
    from importlib import metadata

    by_name: dict[str, str | None] = {"coec": __version__, "python": platform.python_version()}
    for name in DECIDING:
        try:
            by_name[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            by_name[name] = None
    return {**by_name, "machine": platform.machine(), "system": platform.platform(terse=True)}


def _print_versions(requested: bool) -> None:
    """Prints the versions, before anything else on the command line is parsed."""
    if not requested:
        return
    by_name = versions()
    if "--json" in sys.argv[1:]:
        text = json.dumps(by_name, sort_keys=True)
    else:
        own = by_name.pop("coec")
        text = f"coec {own}\n" + ", ".join(f"{name} {version or 'not installed'}" for name, version in by_name.items())
    plain_text.write(f"{text}\n")
    raise typer.Exit(0)


def _coec(
    version: Annotated[  # noqa: ARG001  printed by its callback
        bool,
        typer.Option(
            "--version",
            help="Print the version, and those of what decisions are computed with.",
            callback=_print_versions,
            is_eager=True,
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --version: one JSON document.")] = False,
) -> None:
    # Without a callback, Typer would treat an application with one command as that command itself.
    if as_json:
        raise UsageError("--json before a command belongs to --version; of a command, write it behind its name")


def main() -> int:
    """Entry point; returns the exit status."""
    as_json = "--json" in sys.argv[1:]
    plain_text.never_fail()
    plain_text.escape_interpreter()
    # Without a home directory, matplotlib warns about where it keeps fonts, which is of no interest here.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        command = typer.main.get_command(application(sys.argv[1:]))
        if not plain_text.is_unicode(sys.stdout.encoding):
            _encode_help(sys.stdout.encoding, command)
        with no_interrupt_lost():
            command(prog_name="coec")
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):
            return _unread()
        status = end.code if isinstance(end.code, int) else 0
        # A command that ends like this by itself has printed why.
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            plain_text.write("coec: interrupted\n", on_error=True)
            if as_json:
                _print_error("interrupted", "ended by Ctrl-C before there was a result")
        if status == ExitCode.USAGE and as_json:
            _print_error("bad_request", "the command line does not fit; standard error says how")
        return status
    except CoecError as error:
        plain_text.write(f"coec: {error}\n", on_error=True)
        if as_json:
            _print_error(error.reply_code, str(error), error.details)
        return error.exit_code
    except BrokenPipeError:
        return _unread()
    except Exception as error:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            sys.stdout = None
            message = f"coec: cannot write: {error.strerror}; make room where the output goes\n"
            plain_text.write(message, on_error=True)
            return ExitCode.FAILED
        plain_text.write_traceback(error)
        if as_json:
            _print_error("internal", f"{type(error).__name__}: {error}")
        return ExitCode.FAULT
    return 0


def _unread() -> int:
    """The reader of our output has gone, so nothing more is printed, not even by the interpreter at its exit."""
    sys.stdout = None
    return ExitCode.BROKEN_PIPE


def _encode_help(encoding: str, command: Any) -> None:
    """Replaces signs that the locale's encoding lacks in the help texts of a command and its subcommands, which would
    otherwise be printed as UTF-8."""
    for each in (command, *command.params):
        if getattr(each, "help", None):
            each.help = plain_text.encodable(each.help, encoding)
    for below in getattr(command, "commands", {}).values():
        _encode_help(encoding, below)


def _print_error(code: str, message: str, details: Mapping[str, Any] | None = None) -> None:
    document = {"error": {"code": code, "message": message}, **(details or {})}
    plain_text.write(f"{json_printable(json.dumps(document, ensure_ascii=False))}\n")
