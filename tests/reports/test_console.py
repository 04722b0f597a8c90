"""What a person reads of a figure: its limit and a mark, or neither."""

from __future__ import annotations

import ast
import logging
import subprocess
import sys
from pathlib import Path

import pytest
from rich.text import Text

import coec
from coec.reports import console
from coec.reports.console import Bars, PlainColumn
from coec.schemas.replies import MetricReply
from support.strategies import HOSTILE, obeyed_characters


@pytest.mark.parametrize(
    ("limit", "at_least", "passed", "shown"),
    [
        (0.5, True, True, ("≥ 0.500", "✓")),
        (0.25, False, False, ("≤ 0.250", "✗")),
        (None, True, True, ("", "")),
    ],
)
def test_a_figure_without_a_limit_keeps_none(
    limit: float | None, at_least: bool, passed: bool, shown: tuple[str, str]
) -> None:
    text, mark = console.limit_of(MetricReply(value=1.0, limit=limit, at_least=at_least, passed=passed))
    assert (text, mark.plain) == shown


@pytest.mark.fault("a text from a vehicle with control sequences for a terminal", "they are shown as escapes")
def test_what_arrived_over_a_network_moves_no_cursor(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "a\x1b[2J\x07b [red]c[/red]\r"
    console.show(evil)
    console.say(evil)
    table = console.table("[x]", "y")
    table.add_row(evil, console.styled("healthy"))
    console.out.print(table)
    captured = capsys.readouterr()
    for text in (captured.out, captured.err):
        assert not {"\x1b", "\x07", "\r"} & set(text)
        assert r"a\x1b[2J\x07b [red]c[/red]\r" in text


def terminal() -> console.EscapingConsole:
    """With colours, on what pytest captures."""
    return console.EscapingConsole(force_terminal=True, color_system="truecolor", width=100)


def test_whatever_rich_is_given_it_sends_a_terminal_its_own_sequences_only(capsys: pytest.CaptureFixture[str]) -> None:
    screen = terminal()
    screen.print(HOSTILE, Text(HOSTILE, "bold red"), [HOSTILE], sep=HOSTILE, end=HOSTILE)
    screen.print(console.styled(HOSTILE))
    screen.out(HOSTILE)
    screen.rule(HOSTILE)
    for column in (Text(HOSTILE), HOSTILE):
        table = console.table(HOSTILE)
        table.add_row(column)
        screen.print(table)
    with Bars(screen, console.say, counted=True) as bars:
        bars.update(bars.add_task(HOSTILE, total=1, note=HOSTILE), completed=1, note=HOSTILE)
        bars.refresh()
    written = capsys.readouterr().out
    assert "\x1b[1;31m" in written, "its own styles are there"
    assert obeyed_characters(written, styled=True) == ""
    assert "[red]" in written, "markup is text"


def test_markup_in_the_text_of_a_bar_is_text() -> None:
    bars = Bars(terminal(), console.say, counted=False)
    task = bars.add_task("[red]front[/red]\n", note="[link=x]y")
    (shown,) = [PlainColumn("{task.description}").render(one) for one in bars.tasks if one.id == task]
    assert shown.plain == r"[red]front[/red]\n"
    assert not shown.spans


@pytest.mark.fault("an exception in a thread or a callback quotes a reply", "its traceback has escapes in place of it")
def test_what_the_interpreter_prints_by_itself_is_escaped() -> None:
    program = (
        "import logging, sys, threading\n"
        "from coec.reports import formatting\n"
        "formatting.escape_interpreter()\n"
        "evil = '\\x1b[35;45m\\x9b\\r'\n"
        "def fail(): raise ValueError(evil)\n"
        "thread = threading.Thread(target=fail); thread.start(); thread.join()\n"
        "logging.getLogger('x').warning(evil)\n"
        "fail()\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, encoding="utf-8")
    assert finished.returncode == 1
    assert finished.stderr.count(r"ValueError: \x1b[35;45m\x9b\r") == 2
    assert finished.stderr.count(r"\x1b[35;45m\x9b\r") == 3
    assert obeyed_characters(finished.stderr) == ""
    assert logging.lastResort is not None


PACKAGE = Path(coec.__file__).parent
SINKS = {
    PACKAGE / "reports" / "formatting.py",
    PACKAGE / "reports" / "console.py",
    # Each of its formatters escapes the line that it makes.
    PACKAGE / "io" / "logs.py",
    # It prints fixed texts of the repository, and only its developers run it.
    PACKAGE.parent / "coec_lab" / "experiments" / "schema_export.py",
}
"""Where text may go to standard output and standard error."""

PRINTS = {"print", "typer.echo", "typer.secho", "click.echo", "click.secho", "rich.print", "traceback.print_exc",
          "traceback.print_exception", "Console", "rich.console.Console", "os.write"}  # fmt: skip
STREAMS = {"sys.stdout", "sys.stderr", "sys.__stdout__", "sys.__stderr__"}
HARMLESS = {"isatty", "encoding"}
"""What may be asked of a stream anywhere."""

DISPLAYS = {"Live", "Progress"}
"""Displays of rich that make a console of their own unless they are given one."""

LAST_TEXT = {name.rpartition(".")[2] for name in PRINTS | DISPLAYS}
STREAM_NAMES = {name.rpartition(".")[2] for name in STREAMS}


def bypasses(path: Path) -> list[str]:
    """What a module prints with, or could print with, other than the sink."""
    text = path.read_text()
    if not any(name in text for name in LAST_TEXT | STREAM_NAMES):
        return []
    nodes = list(ast.walk(ast.parse(text)))
    harmless = {id(node.value) for node in nodes if isinstance(node, ast.Attribute) and node.attr in HARMLESS}
    result = []
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            if (node.func.id if isinstance(node.func, ast.Name) else node.func.attr) not in LAST_TEXT:
                continue
            name, given = ast.unparse(node.func), {keyword.arg for keyword in node.keywords}
            alone = name in DISPLAYS and "from rich" in text and "console" not in given
            if name in PRINTS or alone:
                result.append((node.lineno, name))
        elif (
            isinstance(node, ast.Attribute)
            and node.attr in STREAM_NAMES
            and isinstance(node.ctx, ast.Load)
            and id(node) not in harmless
        ):
            result += [(node.lineno, stream) for stream in STREAMS & {ast.unparse(node)}]
    return [f"{path.relative_to(PACKAGE.parent)}:{line}: {name}" for line, name in result]


def test_nothing_prints_but_through_the_one_place_that_escapes() -> None:
    modules = {*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "coec_lab").rglob("*.py")}
    assert modules > SINKS
    assert [result for path in sorted(modules - SINKS) for result in bypasses(path)] == []


def test_a_module_that_prints_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "coec")
    path = tmp_path / "m.py"
    path.write_text("from rich.live import Live\nimport sys\nout = sys.stderr\nprint(1)\nLive()\nsys.stdout.isatty()\n")
    assert sorted(bypasses(path)) == ["m.py:3: sys.stderr", "m.py:4: print", "m.py:5: Live"]
