"""Terminals that can do less: no colours, no signs beyond ASCII, nothing that moves."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import entry_points

import pytest
from rich.text import Text

from coec import extensions
from coec.cli.main import BUILT_IN, application
from coec.reports import console, formatting

SIGNS = "185° ± 0.3 ≥ 1 ✓ −2 σ²"


def ascii_stream() -> io.TextIOWrapper:
    """As standard output is in an ASCII locale."""
    return io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")


def written(stream: io.TextIOWrapper) -> str:
    """What arrived."""
    stream.flush()
    assert isinstance(stream.buffer, io.BytesIO)
    return stream.buffer.getvalue().decode("ascii")


def test_signs_become_text_in_ascii(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = ascii_stream()
    monkeypatch.setattr(sys, "stdout", stream)
    formatting.never_fail()
    monkeypatch.setattr(console, "out", console.made({}))
    console.show(SIGNS)
    table = console.table("± σ", "limit")
    table.add_row("−2.0°", "≥ 1")
    console.out.print(table)
    console.print_json({"text": SIGNS})
    shown = written(stream)
    assert "185deg +- 0.3 >= 1 ok -2 sigma^2" in shown
    assert "+- sigma" in shown
    # A document loses nothing.
    assert "185\\u00b0" in shown


def test_a_sign_without_a_word_is_a_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = ascii_stream()
    monkeypatch.setattr(sys, "stdout", stream)
    formatting.never_fail()
    print("漢字 [box]", Text("é"))
    assert written(stream).startswith("?? [box]")


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {"TERM": "dumb"}, {"TERM": "dumb", "FORCE_COLOR": "1"}])
def test_where_it_is_requested_nothing_but_text_is_sent(
    environment: Mapping[str, str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("NO_COLOR", "TERM", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(console, "err", console.made(environment, on_error=True))
    out = console.made(environment)
    out.print(console.styled("healthy"), Text("x", style="bold red"))
    with console.progress() as bars:
        bars.update(bars.add_task("work", total=2, note=""), completed=1)
    captured = capsys.readouterr()
    assert "healthy" in captured.out
    assert "\x1b" not in captured.out + captured.err


def test_help_of_everything_is_plain_where_the_locale_is_ascii() -> None:
    code = (
        "import sys, os\n"
        "from coec.cli.main import main\n"
        "for words in eval(sys.argv[1]):\n"
        "    sys.argv = ['coec', *words, '--help']\n"
        "    main()\n"
    )
    names = (*BUILT_IN, *(point.name for point in entry_points(group=extensions.COMMANDS)))
    text = [[], *(name.split(".") for name in names), ["sim", "drive"], ["sim", "matrix"]]
    environment = {"PYTHONPATH": ":".join(sys.path), "PYTHONIOENCODING": "ascii", "TERM": "dumb", "PATH": os.defpath}
    done = subprocess.run([sys.executable, "-c", code, repr(text)], capture_output=True, env=environment)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.isascii()
    assert b"185deg" in done.stdout
    assert b"\x1b" not in done.stdout
    assert not done.stderr


def test_a_terminal_that_can_gets_the_whole_of_it() -> None:
    assert formatting.is_unicode("UTF-8")
    assert not formatting.wants_plain({"TERM": "xterm-256color", "NO_COLOR": ""})
    assert application(["check"]).rich_markup_mode == ("rich" if formatting.is_unicode(sys.stdout.encoding) else None)
