"""The checks that are kept: over a restart, within bounds, and whatever a power cut left of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from coec.errors import StateError
from coec.schemas.replies import CheckReply, MetricReply
from coec.service.records.history import CheckLog
from support.disk import EVERY_OPERATION, Disk

NONE = (None,) * 6


def check(stamp_ns: int) -> CheckReply:
    return CheckReply(
        stamp_ns=stamp_ns,
        pair_stamps_ns=(stamp_ns - 1, stamp_ns),
        flagged=False,
        weak=False,
        flagged_by_paper=None,
        causes=(),
        metrics={"mi": MetricReply(value=1 / 3, limit=None, at_least=True, passed=True)},
        first_derivative=(1 / 7, None, None, None, None, None),
        second_derivative=NONE,
        offset=NONE,
        sigma=NONE,
        drift=None,
        drift_sigma=None,
        outcome="clear",
        evidence=0.5,
        state="healthy",
    )


def test_a_restart_finds_the_same_checks_and_goes_on(tmp_path: Path) -> None:
    log = CheckLog(tmp_path / "checks", 10)
    for stamp_ns in range(3):
        log.append(check(stamp_ns))
        log.flush()
    again = CheckLog(tmp_path / "checks", 10)
    assert again.checks() == log.checks() == tuple(check(stamp_ns) for stamp_ns in range(3))
    again.append(check(3))
    again.flush()
    assert CheckLog(tmp_path / "checks", 10).checks() == again.checks()


def test_the_newest_are_retained_and_the_file_stays_bounded(tmp_path: Path) -> None:
    log = CheckLog(tmp_path / "checks", 3)
    for stamp_ns in range(20):
        log.append(check(stamp_ns))
        log.flush()
    assert [one.stamp_ns for one in log.checks()] == [17, 18, 19]
    assert len((tmp_path / "checks").read_bytes().splitlines()) <= 6
    assert CheckLog(tmp_path / "checks", 3).checks() == log.checks()


def test_what_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    log = CheckLog(tmp_path / "checks", 10)
    for stamp_ns in range(3):
        log.append(check(stamp_ns))
        log.flush()
    first, second, third = (tmp_path / "checks").read_bytes().splitlines(keepends=True)
    (tmp_path / "checks").write_bytes(first + b"\xff{\n" + second + third[:40])
    again = CheckLog(tmp_path / "checks", 10)
    again.append(check(7))
    again.flush()
    assert [one.stamp_ns for one in CheckLog(tmp_path / "checks", 10).checks()] == [0, 1, 7]


def test_a_full_disk_costs_no_check_but_those_that_a_restart_comes_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(tmp_path, monkeypatch)
    log = CheckLog(tmp_path / "checks", 10)
    log.append(check(0))
    log.flush()
    disk.refuses = EVERY_OPERATION
    log.append(check(1))
    with pytest.raises(StateError, match="No space"):
        log.flush()
    assert [one.stamp_ns for one in log.checks()] == [0, 1]
    assert [one.stamp_ns for one in CheckLog(tmp_path / "checks", 10).checks()] == [0]
    disk.refuses = ()
    log.append(check(2))
    log.flush()
    assert [one.stamp_ns for one in CheckLog(tmp_path / "checks", 10).checks()] == [0, 1, 2]
