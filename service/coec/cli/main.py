"""The frame of the command line: finds the command, runs it, and turns its outcome into an exit status.

A command is a function with the parameters that Typer reads, whose docstring is its help and which returns the exit
status. In this package every module beside `main` and `options`, and every folder, is a command with its name and its
function's; or a group of commands, a `typer.Typer` that is called `app`. Another package adds commands by entry points
(`coec.extensions`). Exit codes (CONTRACT, "Command line") are those of `coec.errors`. With `--json`, standard
output holds one JSON document and nothing else.
"""

from __future__ import annotations

import _thread
import errno
import inspect
import json
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated, Any

import typer

from coec import __version__, cli
from coec.errors import CoecError, ExitCode, UsageError
from coec.reports import formatting
from coec.untrusted import json_printable

SHARED = frozenset({"main", "options"})
"""Modules of this package that are no commands."""

# fmt: off
ORDER = (
    "calibrate", "commission", "diagnose", "run", "check-config", "doctor", "play", "query", "watch", "fetch", "view",
    "router", "warmup", "batch", "replay", "convert", "check", "lidars", "export", "models", "fleet",
)
# fmt: on
"""Commands that the help text lists first, in the order of the work; all others follow."""

BUILT_IN = tuple(
    sorted(
        (module.name.replace("_", "-") for module in iter_modules(cli.__path__) if module.name not in SHARED),
        key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER),
    )
)
"""Commands of this package, known before any is imported."""

DECIDING = ("numpy", "numba", "llvmlite", "onnxruntime", "opencv-python-headless", "nlopt", "eclipse-zenoh")
"""Distributions whose other versions may round, sample or order differently. Where two machines decide differently,
these may differ."""

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a write to standard output or to a temporary file that are no fault of coec."""


def application(arguments: Sequence[str]) -> typer.Typer:
    """The commands that a command line may need: the one that its first argument names, or all if it names none, for
    the help text or the error. Importing all takes some tens of milliseconds, so most calls import only one."""
    plain = formatting.wants_plain(os.environ) or not formatting.is_unicode(sys.stdout.encoding)
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
    commands: dict[str, Any] = {}
    if first in BUILT_IN:
        commands[first] = _add(app, first, _command(first), None)
        # Of the commands here, only groups get subcommands from other packages.
        others = {} if commands[first] is None else _added_commands()
    else:
        others = _added_commands()
    if first in BUILT_IN or first in others:
        others = {name: load for name, load in others.items() if first in (name, name.partition(".")[0])}
    else:
        commands = {name: _add(app, name, _command(name), None) for name in BUILT_IN}
    for name in sorted(others, key=lambda name: "." in name):  # groups before what is added to them
        group, _, subcommand = name.rpartition(".")
        if not group:
            commands[name] = _add(app, name, others[name](), "Laboratory")
        elif group in commands:
            _add(commands[group], subcommand, others[name](), None)
    return app


def _command(name: str) -> Any:
    """The command in a module of this package: a function, or a group."""
    own = name.replace("-", "_")
    module = import_module(f"{cli.__name__}.{own}")
    return module.app if hasattr(module, "app") else getattr(module, own)


def _added_commands() -> dict[str, Callable[[], Any]]:
    """What other packages add, by name: functions that load the commands."""
    from coec.extensions import COMMANDS, added_by_packages  # reads the metadata of all packages, which takes long

    return added_by_packages(COMMANDS)


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
    formatting.write(f"{text}\n")
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
        raise UsageError(
            "--json before a command belongs to --version; for a command, write it after the command's name"
        )


def main() -> int:
    """Entry point; returns the exit status."""
    as_json = "--json" in sys.argv[1:]
    formatting.never_fail()
    formatting.escape_interpreter()
    try:
        command = typer.main.get_command(application(sys.argv[1:]))
        if not formatting.is_unicode(sys.stdout.encoding):
            _encode_help(sys.stdout.encoding, command)
        with no_interrupt_lost():
            command(prog_name="coec")
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):
            return _unread()
        status = end.code if isinstance(end.code, int) else 0
        # A command that ends like this by itself has printed why.
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            formatting.write("coec: interrupted\n", on_error=True)
            if as_json:
                _print_error("interrupted", "ended by Ctrl-C before there was a result")
        if status == ExitCode.USAGE and as_json:
            say = getattr(end.__context__, "format_message", None)
            _print_error("bad_request", say() if say else "the command line does not fit; standard error says how")
        return status
    except CoecError as error:
        formatting.write(f"coec: {error}\n", on_error=True)
        if as_json:
            _print_error(error.reply_code, str(error), error.details)
        return error.exit_code
    except BrokenPipeError:
        return _unread()
    except Exception as error:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            sys.stdout = None
            message = f"coec: cannot write: {error.strerror}; make room where the output goes\n"
            formatting.write(message, on_error=True)
            return ExitCode.FAILED
        formatting.write_traceback(error)
        if as_json:
            _print_error("internal", f"{type(error).__name__}: {error}")
        return ExitCode.FAULT
    return 0


LATER_S = 0.05
"""Delay until a lost Ctrl-C is sent again: by then the call that lost it has returned, or it loses it again."""


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Sends a lost Ctrl-C again a moment later. Python drops a Ctrl-C, with a traceback, if it arrives in a callback
    from C, for example from the compiler."""
    before = sys.unraisablehook

    def resend(what: sys.UnraisableHookArgs) -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            # No `threading.Timer`: its start waits for its thread, and an interrupt within this hook is lost for good.
            _thread.start_new_thread(_interrupt_later, (threading.get_ident(),))
        else:
            before(what)

    sys.unraisablehook = resend
    try:
        yield
    finally:
        sys.unraisablehook = before


def _interrupt_later(thread: int) -> None:
    time.sleep(LATER_S)
    # A signal rather than `interrupt_main`, which does not wake a waiting thread.
    signal.pthread_kill(thread, signal.SIGINT)


def _unread() -> int:
    """The reader of our output has gone, so nothing more is printed, not even by the interpreter at its exit."""
    sys.stdout = None
    return ExitCode.BROKEN_PIPE


def _encode_help(encoding: str, command: Any) -> None:
    """Replaces signs that the locale's encoding lacks in the help texts of a command and its subcommands, which would
    otherwise be printed as UTF-8."""
    for each in (command, *command.params):
        if getattr(each, "help", None):
            each.help = formatting.encodable(each.help, encoding)
    for below in getattr(command, "commands", {}).values():
        _encode_help(encoding, below)


def _print_error(code: str, message: str, details: Mapping[str, Any] | None = None) -> None:
    document = {"error": {"code": code, "message": message}, **(details or {})}
    formatting.write(f"{json_printable(json.dumps(document, ensure_ascii=False))}\n")
