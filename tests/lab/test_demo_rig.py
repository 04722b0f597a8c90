"""The demonstration of a rig: what counts as told apart, what it leaves, and its last hop."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

from dataclasses import replace

from cli.conftest import Coec
from coec.reports.rig_plot import EdgeSeen
from coec.simulation import drawing
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigConfig, RigDrive
from coec_lab.demo.rig import performance, report, story
from coec_lab.demo.rig.outcome import Outcome, is_over, outcome_of
from coec_lab.demo.rig.told import NS_PER_S, SensorTold, Told, told_of
from coec_lab.demo.rig.vehicle import AHEAD, Frames, RigVehicle
from rig_replies import knocked, untold
from runtime.api.test_metrics import a_health

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


class AtOnce(Executor):
    """In this process, when it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.asked += 1
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


def vehicle_of(executor: Executor) -> RigVehicle:
    drawing.begin(tuple(story.drive_config(act) for act in (None, *story.ACTS)))
    return RigVehicle(drawing.Drawers(executor))


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
    vehicle = vehicle_of(AtOnce())
    first, second = (list(vehicle.frames(act)) for act in story.ACTS)
    assert len(first) == len(second) == len(vehicle.plan)
    assert first[0].second < 1.0 < first[-1].second
    for before, after in zip(first, second, strict=True):
        moved = before.sweep.stamp_ns - START_NS >= 1_000_000_000
        assert (before.sweep is after.sweep) is not moved
        for camera, picture in before.pictures.items():
            turned = camera == CAMERA.sensor and picture.stamp_ns - START_NS >= 1_000_000_000
            assert (picture is after.pictures[camera]) is not turned


def test_frames_are_drawn_ahead_of_the_one_that_is_sent_and_not_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(story, "CAMERA_PX", 64)
    monkeypatch.setattr(story, "LONGEST_S", 20.0)
    drawers = AtOnce()
    frames = vehicle_of(drawers).frames(LIDAR)
    assert drawers.asked == 5 * (AHEAD - 1), "all but the first, which compiles what the others then find compiled"
    next(frames)
    assert drawers.asked == 5 * AHEAD


def test_what_the_service_says_is_told_as_it_is() -> None:
    offset = (0.3, 0.4, None, 0.0, 0.0, None)
    taken = a_health().check
    assert taken is not None
    check = taken.model_copy(update={"offset": offset, "sigma": (0.1, 0.1, None, 0.01, 0.01, None)})
    blind = taken.model_copy(update={"offset": (None,) * 6, "sigma": (None,) * 6})
    sensors_of = {"front": ("front", "roof"), "left": ("left", "roof")}
    reply = knocked()
    said = told_of(reply, START_NS + 9 * NS_PER_S, ["front", "left"], {"front": check, "left": blind}, sensors_of)
    assert said.second == 9.0
    assert said.looked_at == "front, left"
    assert said.named == {"roof"}
    roof = said.sensors["roof"]
    assert (roof.state, roof.probability, roof.moved_deg) == ("lidar_moved", 0.998, 1.0)
    assert roof.reason.startswith("It moved by 1.00°")
    assert said.edges["front"].deg == pytest.approx(0.5)
    assert said.edges["front"].sigmas == pytest.approx(5.0)
    assert said.edges["left"].sigmas == 0.0, "a pair that cannot tell is no evidence"
    unknown = told_of(untold(), START_NS, [], {}, sensors_of)
    assert (unknown.sensors["roof"].state, unknown.sensors["roof"].probability, unknown.edges) == ("unknown", 0.0, {})


def test_an_act_that_fails_is_an_exit_status(coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent:
        """Tells of nothing but calm."""

        def __init__(self, *_: object) -> None:
            pass

        def hear(self, frames: Frames) -> list[Told]:
            return [told(frames.second)]

        def rest(self) -> list[Told]:
            return [told(story.LONGEST_S)]

    monkeypatch.setattr(performance, "Asker", Silent)
    monkeypatch.setattr(performance, "serving", lambda *_: nullcontext(SimpleNamespace(until_ready=lambda: None)))
    monkeypatch.setattr(story, "CAMERA_PX", 64)
    monkeypatch.setattr(story, "LONGEST_S", 2.0)
    monkeypatch.setattr(performance, "driving", lambda: nullcontext(vehicle_of(AtOnce())))
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path)
    assert outcome.status == 1
    assert [act["knocked"] for act in outcome.document["acts"]] == ["roof", "left"]
    assert not outcome.document["passed"]
    assert all(Path(path).stat().st_size > 0 for path in outcome.document["files"])


@pytest.mark.fault("a service that checks nothing", "said in a sentence, and no page is written")
def test_a_service_that_tells_nothing_is_an_error(coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Mute:
        def __init__(self, *_: object) -> None:
            pass

        def hear(self, _: Frames) -> list[Told]:
            return []

        def rest(self) -> list[Told]:
            return []

    monkeypatch.setattr(performance, "Asker", Mute)
    monkeypatch.setattr(performance, "serving", lambda *_: nullcontext(SimpleNamespace(until_ready=lambda: None)))
    monkeypatch.setattr(story, "CAMERA_PX", 64)
    monkeypatch.setattr(story, "LONGEST_S", 2.0)
    monkeypatch.setattr(performance, "driving", lambda: nullcontext(vehicle_of(AtOnce())))
    outcome = coec("demo", "--rig", "--output", tmp_path / "demo")
    assert outcome.status != 0
    assert "looked at none of its pairs" in outcome.err
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
@pytest.mark.fault(
    "a LiDAR, and on another drive a camera, is knocked by 1°", "that sensor alone is named, within a minute"
)
def test_a_knocked_lidar_and_a_knocked_camera_are_told_apart(
    coec: Coec, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path / "demo")
    document = outcome.document
    assert outcome.status == 0, [act["objections"] for act in document["acts"]]
    delays_s = [act["named_s"] - act["knock_s"] for act in document["acts"]]
    assert all(0.0 < delay_s <= 60.0 for delay_s in delays_s)
    record_property("figure", " and ".join(f"{delay_s:.0f} s" for delay_s in delays_s) + " of driving")
