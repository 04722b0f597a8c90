"""Stamps as people read them."""

from __future__ import annotations

import pytest

from coec.reports.instants import instant


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1_369_730_773_341_999_999, "2013-05-28T08:46:13.341Z"),
        (946_684_800_000_000_000, "2000-01-01T00:00:00.000Z"),
        (946_684_799_999_000_000, "946684799.999 s"),
        (20_000_000_000, "20.000 s"),
        (0, "0.000 s"),
        (-1_500_000_000, "-1.500 s"),
        (2**63 - 1, "2262-04-11T23:47:16.854Z"),
        (10**30, "1000000000000000000000.000 s"),
    ],
)
def test_a_stamp_is_a_date_in_utc_where_it_is_one(stamp_ns: int, text: str) -> None:
    assert instant(stamp_ns) == text
