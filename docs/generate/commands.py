"""The pages on the command line, from the tree of commands that parses it, and on the package, from its public
names."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import ismodule
from typing import Any, get_args

import typer

import coec
from coec.cli.main import application
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


PYTHON_HEAD = """\
# Python

{written}
{doc}

{entries}"""


def commands_page() -> str:
    """Markdown: each command, once, with its arguments and options."""
    commands = list(_commands(typer.main.get_command(application(())), ()))
    rows = [
        (f"[`{name}`](#{_anchor(name)})", prose(_first_sentence(command.help or "")))
        for name, command in ((_name(path), command) for path, command in commands)
    ]
    sections = "\n".join(_section(path, command) for path, command in commands)
    return HEAD.format(written=WRITTEN, commands=table(("command", "what it does"), rows), sections=sections)


def _commands(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The command itself, unless it is the program or a group without an action of its own, and its subcommands."""
    below = getattr(command, "commands", {})
    if path and (not below or command.invoke_without_command):
        yield path, command
    for name, child in below.items():
        yield from _commands(child, (*path, name))


def _section(path: tuple[str, ...], command: Any) -> str:
    arguments = [one for one in command.params if not one.opts[0].startswith("-")]
    options = [one for one in command.params if one.opts[0].startswith("-")]
    usage = " ".join((_name(path), *map(_argument, arguments), *(["[OPTIONS]"] if options else [])))
    items = "".join(_item(_argument(one).strip("[]"), one) for one in arguments) + "".join(
        _item(_option(one), one) for one in options
    )
    return f"## {_name(path)}\n\n{_help(command.help or '')}\n\n```text\n{usage}\n```\n\n{items}"


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
    sentences = [prose(parameter.help)]
    choices = get_args(parameter.type_descriptor.annotation)
    if choices and all(isinstance(choice, str) for choice in choices):
        sentences.append(f"One of {', '.join(map(code, choices))}.")
    default = _default(parameter)
    if default is not None:
        is_sentence = isinstance(default, str) and " " in default
        sentences.append(f"Default: {prose(str(default)) if is_sentence else code(default)}.")
    elif parameter.required and term.startswith("-"):
        sentences.append("Required.")
    return f"`{term}`\n:   {' '.join(sentences)}\n\n"


def _default(parameter: Any) -> object | None:
    """The default of a parameter, if it is a value that informs the reader."""
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


def _name(path: tuple[str, ...]) -> str:
    return " ".join(("coec", *path))


def _anchor(name: str) -> str:
    return name.replace(" ", "-")


def _first_sentence(text: str) -> str:
    return " ".join(text.split()).partition(". ")[0].rstrip(".")


def python_page() -> str:
    """Markdown: the docstring of the package, and an entry for each name in `coec.__all__`."""
    public = sorted(getattr(coec, "__all__", ("__version__",)), key=str.lower)
    return PYTHON_HEAD.format(written=WRITTEN, doc=(coec.__doc__ or "").strip(), entries="\n".join(map(_entry, public)))


def _entry(name: str) -> str:
    """The entry of a name. Data have no docstring at run time, so their value is shown."""
    value = getattr(coec, name)
    heading = f'<a id="coec.{name}"></a>\n\n## `coec.{name}`\n\n'
    home = getattr(value, "__module__", None)
    if ismodule(value):
        source = value.__name__
    elif home is not None:
        source = f"{home}.{value.__qualname__}"
    else:
        return f"{heading}`{value!r}`\n"
    return f"{heading}::: {source}\n    options:\n      show_root_heading: false\n      heading_level: 3\n"
