"""The looks that are kept: over a restart, within bounds, and whatever a power cut left of them."""

from __future__ import annotations

from pathlib import Path

from coec.runtime.decisions.check_log import LookLog
from coec.schemas.replies import LookReply, MetricReply

NONE = (None,) * 6


def look(stamp_ns: int) -> LookReply:
    return LookReply(
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


def test_a_restart_finds_the_same_looks_and_goes_on(tmp_path: Path) -> None:
    log = LookLog(tmp_path / "looks", 10)
    for stamp_ns in range(3):
        log.append(look(stamp_ns))
    again = LookLog(tmp_path / "looks", 10)
    assert again.looks() == log.looks() == tuple(look(stamp_ns) for stamp_ns in range(3))
    again.append(look(3))
    assert LookLog(tmp_path / "looks", 10).looks() == again.looks()


def test_the_newest_are_kept_and_the_file_stays_bounded(tmp_path: Path) -> None:
    log = LookLog(tmp_path / "looks", 3)
    for stamp_ns in range(20):
        log.append(look(stamp_ns))
    assert [one.stamp_ns for one in log.looks()] == [17, 18, 19]
    assert len((tmp_path / "looks").read_bytes().splitlines()) <= 6
    assert LookLog(tmp_path / "looks", 3).looks() == log.looks()


def test_what_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    log = LookLog(tmp_path / "looks", 10)
    for stamp_ns in range(3):
        log.append(look(stamp_ns))
    first, second, third = (tmp_path / "looks").read_bytes().splitlines(keepends=True)
    (tmp_path / "looks").write_bytes(first + b"\xff{\n" + second + third[:40])
    again = LookLog(tmp_path / "looks", 10)
    again.append(look(7))
    assert [one.stamp_ns for one in LookLog(tmp_path / "looks", 10).looks()] == [0, 1, 7]
