"""The command line. `commands` declares the options of each command; the module of the same name here does its work.

Exit codes (CONTRACT, "Command line") are those of `coec.exit_codes`. With `--json`, standard output holds one JSON
document and nothing else.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from coec.cli.declaring import taking
from coec.cli.stopping import no_interrupt_lost
from coec.errors import CoecError, UsageError
from coec.exit_codes import ExitCode
from coec.reports import plain_text
from coec.untrusted import json_printable

GROUPS = ("models", "sim", "fleet")
"""Commands with subcommands."""

COMMANDS = (
    "calibrate",
    "evaluate",
    "commission",
    "diagnose",
    "alarms",
    "paper",
    "run",
    "check-config",
    "doctor",
    "play",
    "query",
    "watch",
    "fetch",
    "view",
    "router",
    "warmup",
    "batch",
    "replay",
    "convert",
    "sbom",
    "bench",
    "check",
    "lidars",
    "export",
    "demo",
)
"""Commands in the order of the help text."""


NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a write to standard output or to a temporary file that are no fault of coec."""


def application(words: Sequence[str]) -> typer.Typer:
    """The commands that a command line may need: the one that its first word names, or all if it names none, for the
    help text or the error. Declaring a command takes a millisecond, so most calls declare only one."""
    plain = plain_text.wants_plain(os.environ) or not plain_text.is_unicode(sys.stdout.encoding)
    app = typer.Typer(
        name="coec",
        no_args_is_help=True,
        rich_markup_mode=None if plain else "rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Continuous online extrinsic calibration of a camera and a LiDAR.",
    )
    app.callback()(_coec)
    named = [name for name in (*GROUPS, *COMMANDS) if name in words[:1]] or [*GROUPS, *COMMANDS]
    for name in named:
        module = import_module(f"coec.cli.commands.{name.replace('-', '_')}")
        if name in GROUPS:
            app.add_typer(module.app, name=name)
        else:
            app.command(name)(taking(module.run))
    return app


def _tell_version(asked: bool) -> None:
    """Prints the version, before anything else on the command line is parsed."""
    if asked:
        from coec.cli import version as work

        output = json.dumps(work.document(), sort_keys=True) if "--json" in sys.argv[1:] else work.text()
        plain_text.write(f"{output}\n")
        raise typer.Exit(0)


def _coec(
    version: Annotated[  # noqa: ARG001  told by its callback
        bool,
        typer.Option(
            "--version",
            help="Print the version, and those of what decisions are computed with.",
            callback=_tell_version,
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
            _with_signs_of(sys.stdout.encoding, command)
        with no_interrupt_lost():
            command(prog_name="coec")
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):
            return _unread()
        status = ended.code if isinstance(ended.code, int) else 0
        # A command that ends like this by itself has printed why.
        if isinstance(getattr(ended.__context__, "__cause__", None), KeyboardInterrupt):
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


def _with_signs_of(encoding: str, command: Any) -> None:
    """Replaces signs that the locale's encoding lacks in the help texts of a command and its subcommands, which would
    otherwise be printed as UTF-8."""
    for told in (command, *command.params):
        if getattr(told, "help", None):
            told.help = plain_text.encodable(told.help, encoding)
    for below in getattr(command, "commands", {}).values():
        _with_signs_of(encoding, below)


def _print_error(code: str, message: str, details: Mapping[str, Any] | None = None) -> None:
    document = {"error": {"code": code, "message": message}, **(details or {})}
    plain_text.write(f"{json_printable(json.dumps(document, ensure_ascii=False))}\n")
