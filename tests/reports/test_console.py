"""What a person reads of a figure: its limit and a mark, or neither."""

from __future__ import annotations

import pytest

from coec.reports import console
from coec.schemas.replies import MetricReply


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
def test_what_came_over_a_network_moves_no_cursor(capsys: pytest.CaptureFixture[str]) -> None:
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
