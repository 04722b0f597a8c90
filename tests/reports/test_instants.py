"""Stamps as people read them."""

from __future__ import annotations

import pytest

from coec.reports.formatting import day, instant, second


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1_369_730_773_341_999_999, "2013-05-28 08:46:13.341Z"),
        (946_684_800_000_000_000, "2000-01-01 00:00:00.000Z"),
        (946_684_799_999_000_000, "946684799.999 s"),
        (20_000_000_000, "20.000 s"),
        (0, "0.000 s"),
        (-1_500_000_000, "-1.500 s"),
        (2**63 - 1, "2262-04-11 23:47:16.854Z"),
        (10**30, "1000000000000000000000.000 s"),
    ],
)
def test_a_stamp_is_a_date_in_utc_where_it_is_one(stamp_ns: int, text: str) -> None:
    assert instant(stamp_ns) == text


@pytest.mark.parametrize(
    ("stamp_ns", "to_the_second", "to_the_day"),
    [
        (1_369_730_773_341_999_999, "2013-05-28 08:46:13Z", "2013-05-28"),
        (20_000_000_000, "20.000 s", "20.000 s"),
        (2**90, "1237940039285380352.000 s", "1237940039285380352.000 s"),
    ],
)
def test_all_forms_agree_on_what_is_a_date(stamp_ns: int, to_the_second: str, to_the_day: str) -> None:
    assert second(stamp_ns) == to_the_second
    assert day(stamp_ns) == to_the_day
