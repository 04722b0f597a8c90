"""The demonstration of a rig: what counts as told apart, what it leaves, and its last hop."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

from dataclasses import replace

from cli.conftest import Coec
from coec.cli.demo.rig import performance, report, story
from coec.cli.demo.rig.outcome import Outcome, is_over, outcome_of
from coec.cli.demo.rig.told import Beholder, SensorTold, Told
from coec.cli.demo.rig.vehicle import Frames, RigVehicle
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.rig_looks import TURN_S
from coec.reports.rig_plot import EdgeSeen
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigConfig, RigDrive
from coec.simulation.rig_instants import instants
from coec.sources.recording import Message

LIDAR, CAMERA = story.ACTS
SENSORS = ("front", "left", "rear", "right", "roof")
KNOCK_S = story.KNOCK_S


def told(second: float, *moved: str) -> Told:
    def sensor(name: str) -> SensorTold:
        kind = "lidar" if name == "roof" else "camera"
        state = f"{kind}_moved" if name in moved else "calibrated"
        return SensorTold(name, kind, state, 0.99 if name in moved else 0.001, 1.0 if name in moved else None, "<why>")

    edges = {f"{name}-roof": EdgeSeen(name, "roof", 0.1, 0.1) for name in SENSORS[:-1]}
    return Told(second, "front-roof", {name: sensor(name) for name in SENSORS}, edges)


QUIET, NAMED = told(KNOCK_S - 9.0), told(KNOCK_S + 14.0, "left")


def test_the_sensor_that_was_knocked_has_to_be_named_and_to_stay_so() -> None:
    came_true = outcome_of(CAMERA, [QUIET, told(KNOCK_S + 4.0), NAMED, told(KNOCK_S + 20.0, "left")])
    assert came_true == Outcome(CAMERA, KNOCK_S + 14.0, ())
    assert came_true.passed
    assert not is_over(came_true, NAMED)
    assert is_over(came_true, told(KNOCK_S + 14.0 + story.REST_S, "left"))
    assert outcome_of(CAMERA, [QUIET, NAMED, told(KNOCK_S + 20.0)]).named_s is None


@pytest.mark.parametrize(
    ("heard", "complaint"),
    [
        ((QUIET,), "left was knocked, and is not named"),
        ((QUIET, told(KNOCK_S + 9.0, "left", "roof")), "left was knocked, and is not named"),
        ((QUIET, told(KNOCK_S + 9.0, "left", "roof"), NAMED), "roof was said to have moved, and had not"),
        ((told(KNOCK_S - 1.0, "left"), NAMED), "left was said to have moved, and had not"),
    ],
)
def test_an_act_that_did_not_come_true(heard: tuple[Told, ...], complaint: str) -> None:
    outcome = outcome_of(CAMERA, heard)
    assert not outcome.passed
    assert complaint in " ".join(outcome.objections())
    assert complaint in report.summary(outcome)


def test_only_what_is_new_is_told(tmp_path: Path) -> None:
    heard = [QUIET, told(KNOCK_S - 4.0), NAMED, replace(NAMED, second=KNOCK_S + 16.0)]
    assert report.turns(heard) == [QUIET, NAMED]
    performances = [(outcome_of(LIDAR, [QUIET]), [QUIET]), (outcome_of(CAMERA, heard), heard)]
    files = report.write(tmp_path, RigDrive(RigConfig(seconds=1.0, camera="fisheye64")), performances)
    assert [path.name for path in files] == ["lidar_knocked.png", "camera_knocked.png", "report.html"]
    page = files[-1].read_text()
    assert page.count('src="data:image/png;base64,') == page.count("src=") == 2
    assert "roof was knocked, and is not named at the end" in page
    assert "named 14 s later, it alone" in page
    assert "&lt;why&gt;" in page, "what others say is text"
    document = report.document(performances, files, 1.0)
    assert document["passed"] is False


def test_acts_share_the_frames_of_what_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(story, "CAMERA_PX", 64)
    monkeypatch.setattr(story, "KNOCK_S", 1.0)
    monkeypatch.setattr(story, "LONGEST_S", 2.0)
    vehicle = RigVehicle()
    first, second = (list(vehicle.frames(act)) for act in story.ACTS)
    assert len(first) == len(second) == len(vehicle.plan)
    assert first[0].second < 1.0 < first[-1].second
    for before, after in zip(first, second, strict=True):
        moved = before.sweep.stamp_ns - START_NS >= 1_000_000_000
        assert (before.sweep is after.sweep) is not moved
        for camera, picture in before.pictures.items():
            turned = camera == CAMERA.sensor and picture.stamp_ns - START_NS >= 1_000_000_000
            assert (picture is after.pictures[camera]) is not turned


def test_who_looks_for_itself_tells_of_each_pair_in_its_turn() -> None:
    """One instant again and again, each time a little later: no street, no move."""
    drive = RigDrive(RigConfig(seed=3, seconds=0.5, camera="fisheye64", ego_hz=20.0))
    sees = Beholder(drive, story.LIDAR)
    heard: list[Told] = []
    for turn in range(CHECK_PAIRS + 4):
        heard += sees.hear(_once(drive, turn))
    assert [one.looked_at for one in heard] == [f"{camera}-roof" for camera in drive.cameras]
    assert set(heard[-1].sensors) == set(SENSORS)
    assert heard[-1].named == frozenset()
    assert heard[0].sensors["right"].state == "unknown"


def _once(drive: RigDrive, turn: int) -> Frames:
    """The first instant of a drive, so many instants later."""
    (instant,) = instants(drive, story.LIDAR, 1.0)

    def later(message: Message) -> Message:
        return replace(message, stamp_ns=message.stamp_ns + round(turn * TURN_S * 1e9))

    pictures = {camera: later(drive.message(entry)) for camera, entry in instant.pictures.items()}
    motions = tuple(later(drive.message(entry)) for entry in instant.motions)
    return Frames(later(drive.message(instant.sweep)), pictures, motions)


def test_an_act_that_fails_is_an_exit_status(coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent:
        """Tells of nothing but calm."""

        def __init__(self, *_: object) -> None:
            self._told = False

        def hear(self, frames: Frames) -> list[Told]:
            return [told(frames.second)]

    monkeypatch.setattr(performance, "Beholder", Silent)
    monkeypatch.setattr(story, "CAMERA_PX", 64)
    monkeypatch.setattr(story, "LONGEST_S", 2.0)
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path)
    assert outcome.status == 1
    assert [act["knocked"] for act in outcome.document["acts"]] == ["roof", "left"]
    assert not outcome.document["passed"]
    assert all(Path(path).stat().st_size > 0 for path in outcome.document["files"])


@pytest.mark.slow
@pytest.mark.fault("a LiDAR, and on another drive a camera, is knocked by 1°", "it alone is named, and within a minute")
def test_a_knocked_lidar_and_a_knocked_camera_are_told_apart(
    coec: Coec, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path / "demo")
    document = outcome.document
    assert outcome.status == 0, [act["objections"] for act in document["acts"]]
    delays_s = [act["named_s"] - act["knock_s"] for act in document["acts"]]
    assert all(0.0 < delay_s <= 60.0 for delay_s in delays_s)
    record_property("figure", " and ".join(f"{delay_s:.0f} s" for delay_s in delays_s) + " of driving")
