"""The page on the command line, from the tree of commands that parses it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

import typer

from coec.cli import application
from generate.markdown import WRITTEN, code, prose, table

HEAD = """\
# Command line

{written}
Exit codes are those of [operations](operations.md#exit-codes). With `--json`, standard output holds one JSON document
and nothing else; progress and remarks go to standard error. Each command and group also takes `--help` (`-h`). A SOURCE
is described in [recordings](recordings.md#source).

What a vehicle or a recording says is printed with its control characters as escapes (`\\x1b`), so that none of it can
steer the terminal; standard output and standard error hold no other control characters than line breaks, and styles on
a terminal.

{commands}
{sections}"""


def commands_page() -> str:
    """Markdown: each command, once, with its arguments and options."""
    found = list(_commands(typer.main.get_command(application(())), ()))
    rows = [
        (f"[`{name}`](#{_anchor(name)})", prose(_first_sentence(command.help or "")))
        for name, command in ((_name(words), command) for words, command in found)
    ]
    sections = "\n".join(_section(words, command) for words, command in found)
    return HEAD.format(written=WRITTEN, commands=table(("command", "what it does"), rows), sections=sections)


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The command itself, unless it is the program or a group without an action of its own, and its subcommands."""
    below = getattr(command, "commands", {})
    if words and (not below or command.invoke_without_command):
        yield words, command
    for name, child in below.items():
        yield from _commands(child, (*words, name))


def _section(words: tuple[str, ...], command: Any) -> str:
    arguments = [one for one in command.params if not one.opts[0].startswith("-")]
    options = [one for one in command.params if one.opts[0].startswith("-")]
    usage = " ".join((_name(words), *map(_argument, arguments), *(["[OPTIONS]"] if options else [])))
    items = "".join(_item(_argument(one).strip("[]"), one) for one in arguments) + "".join(
        _item(_option(one), one) for one in options
    )
    return f"## {_name(words)}\n\n{_help(command.help or '')}\n\n```text\n{usage}\n```\n\n{items}"


def _help(text: str) -> str:
    """The paragraphs of a help text; those that click prints as they are stay so."""
    paragraphs = text.split("\n\n")
    as_they_are = "\b\n"
    return "\n\n".join(
        f"```text\n{paragraph.removeprefix(as_they_are)}\n```"
        if paragraph.startswith(as_they_are)
        else prose(paragraph)
        for paragraph in paragraphs
    )


def _item(term: str, parameter: Any) -> str:
    remarks = [prose(parameter.help)]
    choices = get_args(parameter.type_descriptor.annotation)
    if choices and all(isinstance(choice, str) for choice in choices):
        remarks.append(f"One of {', '.join(map(code, choices))}.")
    default = _default(parameter)
    if default is not None:
        told_in_words = isinstance(default, str) and " " in default
        remarks.append(f"Default: {prose(str(default)) if told_in_words else code(default)}.")
    elif parameter.required and term.startswith("-"):
        remarks.append("Required.")
    return f"`{term}`\n:   {' '.join(remarks)}\n\n"


def _default(parameter: Any) -> object | None:
    """The default of a parameter, if it is a value that tells the reader something."""
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    value = parameter.default
    return None if value in (None, False, (), []) or callable(value) or parameter.required else value


def _argument(parameter: Any) -> str:
    name = parameter.metavar or parameter.name.upper()
    name = f"{name}..." if parameter.nargs == -1 and not name.endswith("...") else name
    return name if parameter.required else f"[{name}]"


def _option(parameter: Any) -> str:
    names = ", ".join((*parameter.opts, *parameter.secondary_opts))
    if parameter.is_flag:
        return names
    return f"{names} {parameter.metavar or _kind(parameter.type_descriptor.annotation)}"


def _kind(annotation: Any) -> str:
    return (
        "CHOICE"
        if get_args(annotation)
        else {"str": "TEXT", "int": "INTEGER", "float": "NUMBER"}.get(getattr(annotation, "__name__", ""), "PATH")
    )


def _name(words: tuple[str, ...]) -> str:
    return " ".join(("coec", *words))


def _anchor(name: str) -> str:
    return name.replace(" ", "-")


def _first_sentence(text: str) -> str:
    return " ".join(text.split()).partition(". ")[0].rstrip(".")
