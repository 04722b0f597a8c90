"""Red events: kept over a restart, bounded, with what is needed to judge them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coec.errors import NotFoundError, StateError
from coec.io.serialise import transform_of
from coec.schemas.replies import EvidenceEvent, MetricsPoint, Reason
from coec.service.records.incidents import POINTS_AFTER, POINTS_BEFORE, Incidents
from support.disk import EVERY_OPERATION, Disk


def event(stamp: int, before: str | None = "front-1") -> EvidenceEvent:
    return EvidenceEvent(
        event_id=f"front-{stamp}",
        vehicle="test",
        pair="front",
        stamp_ns=stamp,
        wall_ns=7,
        reasons=(Reason(code="bent_mount", text="It moved."),),
        camera_from_lidar=transform_of(np.eye(4)),
        window_before=before,
        metrics=(),
    )


def point(stamp: int) -> MetricsPoint:
    return MetricsPoint(stamp_ns=stamp, state="healthy", metrics={"mi": 0.5, "f1": None})


def result(evidence: Incidents, event_id: str) -> EvidenceEvent:
    return next(each for each in evidence.events() if each.event_id == event_id)


def test_an_event_holds_the_figures_before_and_after_it(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 3)
    for stamp in range(POINTS_BEFORE + 10):
        evidence.note(point(stamp))
    evidence.begin(event(1000))
    for stamp in range(1001, 1001 + POINTS_AFTER + 20):
        evidence.note(point(stamp))
    stamps = [p.stamp_ns for p in result(evidence, "front-1000").metrics]
    assert stamps == [*range(10, POINTS_BEFORE + 10), *range(1001, 1001 + POINTS_AFTER)]


def test_windows_pictures_and_the_end_are_added_and_survive_a_restart(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 3)
    evidence.begin(event(1000))
    assert evidence.awaiting is not None
    evidence.add_window_after("front-2")
    assert evidence.awaiting is None
    assert evidence.add_window_after("front-3") is None
    evidence.add_overlay("front-1000", "after", b"jpeg")
    evidence.resolve(2000, "healthy: corrected")
    evidence.resolve(3000, "again")
    assert evidence.overlay("front-1000", "after") == b"jpeg"
    evidence.flush()
    again = Incidents(tmp_path, "front", 3)
    retained = result(again, "front-1000")
    assert (retained.window_before, retained.window_after, retained.overlays) == ("front-1", "front-2", ("after",))
    assert (retained.resolved_stamp_ns, retained.resolution) == (2000, "healthy: corrected")
    assert again.overlay("front-1000", "after") == b"jpeg"
    assert again.window_ids == {"front-1", "front-2"}
    with pytest.raises(NotFoundError, match="no picture"):
        again.overlay("front-1000", "before")
    with pytest.raises(NotFoundError, match="no such event"):
        again.overlay("../../etc", "before")


def test_the_oldest_goes_when_there_are_too_many(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 2)
    for stamp in (1000, 900, 30_000):
        evidence.begin(event(stamp, f"front-{stamp - 1}"))
        evidence.flush()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["front-30000", "front-900"]
    assert evidence.window_ids == {"front-899", "front-29999"}
    assert [e.event_id for e in Incidents(tmp_path, "front", 2).events()] == ["front-900", "front-30000"]


def test_damaged_and_foreign_folders_are_passed_over(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 2)
    evidence.begin(event(1000))
    evidence.flush()
    (tmp_path / "front-2000").mkdir()
    (tmp_path / "front-2000" / "event.json").write_text("{")
    (tmp_path / "front-1000").rename(tmp_path / "front-3000")
    assert Incidents(tmp_path, "front", 2).events() == ()


@pytest.mark.fault("a disk that takes no evidence", "it costs the evidence, not the service")
def test_a_disk_that_cannot_be_written_costs_evidence_only(tmp_path: Path) -> None:
    (tmp_path / "evidence").write_text("a file")
    evidence = Incidents(tmp_path / "evidence", "front", 2)
    evidence.begin(event(1000))
    with pytest.raises(StateError, match="evidence"):
        evidence.flush()
    assert result(evidence, "front-1000").window_before == "front-1"
    (tmp_path / "evidence").unlink()
    evidence.note(point(1001))
    evidence.flush()
    assert result(Incidents(tmp_path / "evidence", "front", 2), "front-1000").metrics == (point(1001),)


def test_an_event_that_could_not_be_written_is_written_later_however_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(tmp_path, monkeypatch)
    evidence = Incidents(tmp_path, "front", 2)
    disk.refuses = EVERY_OPERATION
    evidence.begin(event(1000))
    for stamp in range(POINTS_AFTER):
        evidence.note(point(stamp))
        with pytest.raises(StateError, match="No space"):
            evidence.flush()
    disk.refuses = ()
    evidence.flush()
    assert len(result(Incidents(tmp_path, "front", 2), "front-1000").metrics) == POINTS_AFTER


def test_half_an_event_of_a_power_cut_is_removed_and_too_many_are_bounded_at_the_start(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 3)
    for stamp in (1000, 2000, 3000):
        evidence.begin(event(stamp))
    evidence.flush()
    for name in ("front-4000", "front-left-5000", "front-notes"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "before.jpg").write_bytes(b"jpeg")
    assert len(Incidents(tmp_path, "front", 2).events()) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "front-2000",
        "front-3000",
        "front-left-5000",
        "front-notes",
    ]


@pytest.mark.fault("a power cut at any byte of evidence", "none that was written is lost")
def test_a_power_cut_at_any_byte_takes_no_evidence_that_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two that are kept the older goes when the third begins."""
    (tmp_path / "disk").mkdir()
    steps: list[Callable[[Incidents], object]] = [
        lambda evidence: evidence.begin(event(1)),
        lambda evidence: evidence.add_overlay("front-1", "before", b"a picture"),
        lambda evidence: evidence.add_window_after("front-2"),
        lambda evidence: evidence.resolve(7, "healthy"),
        lambda evidence: evidence.begin(event(2)),
        lambda evidence: evidence.begin(event(3)),
    ]
    with monkeypatch.context() as patch:
        disk = Disk(tmp_path / "disk", patch)
        evidence = Incidents(tmp_path / "disk", "front", 2)
        for number, step in enumerate(steps):
            step(evidence)
            evidence.flush()
            disk.acknowledge(number)
    count = 0
    for count, cut in enumerate(disk.power_cuts()):
        again = Incidents(cut.restore(tmp_path / str(count)), "front", 2)
        done = len(cut.acknowledged)
        result = {each.event_id: each for each in again.events()}
        expected = {"front-1": 0 < done < 5, "front-2": done >= 5, "front-3": done >= 6}
        assert {event_id for event_id, needed in expected.items() if needed} <= set(result)
        if first := result.get("front-1"):
            assert first.overlays or done < 2
            assert not first.overlays or again.overlay("front-1", "before") == b"a picture" or done >= 5
            assert first.window_after == "front-2" or done < 3
            assert first.resolution == "healthy" or done < 4
        assert len(result) <= 2
    assert count > 1000


@pytest.mark.fault("an event file that another version wrote", "it stays on the disk, and its windows stay protected")
def test_the_windows_of_an_event_that_cannot_be_read_stay_protected(tmp_path: Path) -> None:
    evidence = Incidents(tmp_path, "front", 3)
    evidence.begin(event(1000))
    evidence.begin(event(2000, "front-7"))
    evidence.flush()
    path = tmp_path / "front-1000" / "event.json"
    fields = json.loads(path.read_bytes())
    path.write_text(json.dumps(fields | {"wall_ns": {"utc": 7}}))
    again = Incidents(tmp_path, "front", 3)
    assert [one.event_id for one in again.events()] == ["front-2000"]
    assert again.window_ids == {"front-1", "front-7"}
    assert path.exists()
