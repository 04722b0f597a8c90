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
