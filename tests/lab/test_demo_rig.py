"""The demonstration of a rig: what counts as told apart, what it leaves, and its last hop."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from dataclasses import replace

from cli.conftest import Coec
from coec_lab.demo import rig
from coec_lab.demo.demo_plots import PlottedEdge
from coec_lab.demo.pair_client import NS_PER_S
from coec_lab.demo.rig import (
    AHEAD,
    SCENARIO,
    ActOutcome,
    InstantFrames,
    RigSnapshot,
    RigVehicle,
    Scenario,
    SensorCondition,
    is_over,
    outcome_of,
    snapshot_of,
)
from coec_lab.simulation import parallel
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.rig_drive import RigDrive, RigDriveConfig
from service.api.test_metrics import a_health
from support.messages import moved_lidar_reply, reply_before_checks

pytestmark = pytest.mark.usefixtures("streets")

LIDAR, CAMERA = SCENARIO.acts
SENSORS = ("front", "left", "rear", "right", "roof")
KNOCK_S = SCENARIO.knock_s


def reported(second: float, *moved: str) -> RigSnapshot:
    def sensor(name: str) -> SensorCondition:
        kind = "lidar" if name == "roof" else "camera"
        state = f"{kind}_moved" if name in moved else "calibrated"
        return SensorCondition(
            name, kind, state, 0.99 if name in moved else 0.001, 1.0 if name in moved else None, "<why>"
        )

    edges = {f"{name}-roof": PlottedEdge(name, "roof", 0.1, 0.1) for name in SENSORS[:-1]}
    return RigSnapshot(second, "front-roof", {name: sensor(name) for name in SENSORS}, edges)


class LazyResult(Future[Any]):
    """Computed when somebody wants it."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        super().__init__()
        self._compute = compute

    def result(self, timeout: float | None = None) -> Any:
        if not self.done():
            self.set_result(self._compute())
        return super().result(timeout)


class LazyExecutor(Executor):
    """Works in this process. `asked`: how often it was given something to do."""

    def __init__(self) -> None:
        self.requested = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.requested += 1
        return LazyResult(lambda: fn(*args, **kwargs))


def vehicle_of(executor: Executor, scenario: Scenario) -> RigVehicle:
    parallel.prepare_process(tuple(scenario.drive_config(act) for act in (None, *scenario.acts)))
    return RigVehicle(parallel.FrameRenderers(executor), scenario)


QUIET, NAMED = reported(KNOCK_S - 9.0), reported(KNOCK_S + 14.0, "left")


def test_the_sensor_that_was_displaced_has_to_be_named_and_to_stay_so() -> None:
    correct = outcome_of(CAMERA, [QUIET, reported(KNOCK_S + 4.0), NAMED, reported(KNOCK_S + 20.0, "left")], KNOCK_S)
    assert correct == ActOutcome(CAMERA, KNOCK_S + 14.0, ())
    assert correct.passed
    assert not is_over(correct, NAMED, SCENARIO.rest_s)
    assert is_over(correct, reported(KNOCK_S + 14.0 + SCENARIO.rest_s, "left"), SCENARIO.rest_s)
    assert outcome_of(CAMERA, [QUIET, NAMED, reported(KNOCK_S + 20.0)], KNOCK_S).named_s is None


@pytest.mark.parametrize(
    ("received", "complaint"),
    [
        ((QUIET,), "left was displaced, and is not identified"),
        ((QUIET, reported(KNOCK_S + 9.0, "left", "roof")), "left was displaced, and is not identified"),
        ((QUIET, reported(KNOCK_S + 9.0, "left", "roof"), NAMED), "roof was reported as moved, and had not moved"),
        ((reported(KNOCK_S - 1.0, "left"), NAMED), "left was reported as moved, and had not moved"),
    ],
)
def test_an_act_that_did_not_come_true(received: tuple[RigSnapshot, ...], complaint: str) -> None:
    outcome = outcome_of(CAMERA, received, KNOCK_S)
    assert not outcome.passed
    assert complaint in " ".join(outcome.failures())
    assert complaint in rig.summary(outcome, SCENARIO)


def test_only_what_is_new_is_reported(tmp_path: Path) -> None:
    received = [QUIET, reported(KNOCK_S - 4.0), NAMED, replace(NAMED, second=KNOCK_S + 16.0)]
    assert rig.changes(received) == [QUIET, NAMED]
    performances = [(outcome_of(LIDAR, [QUIET], KNOCK_S), [QUIET]), (outcome_of(CAMERA, received, KNOCK_S), received)]
    files = rig.write(tmp_path, RigDrive(RigDriveConfig(seconds=1.0, camera="fisheye64")), performances, SCENARIO)
    assert [path.name for path in files] == ["lidar_knocked.png", "camera_knocked.png", "report.html"]
    page = files[-1].read_text()
    assert page.count('src="data:image/png;base64,') == page.count("src=") == 2
    assert "roof was displaced, and is not identified at the end" in page
    assert "identified 14 s later, it alone" in page
    assert "&lt;why&gt;" in page, "what others say is text"
    document = rig.document(performances, files, 1.0, SCENARIO)
    assert document["passed"] is False


def test_acts_share_the_frames_of_what_stands_still() -> None:
    vehicle = vehicle_of(LazyExecutor(), Scenario(camera_px=64, knock_s=0.8, longest_s=1.6))
    first, second = (list(vehicle.frames(act)) for act in vehicle.scenario.acts)
    assert len(first) == len(second) == len(vehicle.plan)
    assert first[0].second < 0.8 < first[-1].second
    for before, after in zip(first, second, strict=True):
        moved = before.sweep.stamp_ns - START_NS >= 800_000_000
        assert (before.sweep is after.sweep) is not moved
        for camera, picture in before.pictures.items():
            turned = camera == CAMERA.sensor and picture.stamp_ns - START_NS >= 800_000_000
            assert (picture is after.pictures[camera]) is not turned


def test_frames_are_rendered_ahead_of_the_one_that_is_sent_and_not_to_the_end() -> None:
    drawers = LazyExecutor()
    frames = vehicle_of(drawers, Scenario(camera_px=64, longest_s=20.0)).frames(LIDAR)
    assert drawers.requested == 5 * (AHEAD - 1), "all but the first, which compiles what the others then find compiled"
    next(frames)
    assert drawers.requested == 5 * AHEAD


def test_what_the_service_reports_is_reported_as_it_is() -> None:
    offset = (0.3, 0.4, None, 0.0, 0.0, None)
    taken = a_health().check
    assert taken is not None
    check = taken.model_copy(update={"offset": offset, "sigma": (0.1, 0.1, None, 0.01, 0.01, None)})
    blind = taken.model_copy(update={"offset": (None,) * 6, "sigma": (None,) * 6})
    sensors_of = {"front": ("front", "roof"), "left": ("left", "roof")}
    reply = moved_lidar_reply()
    message = snapshot_of(
        reply, START_NS + 9 * NS_PER_S, ["front", "left"], {"front": check, "left": blind}, sensors_of
    )
    assert message.second == 9.0
    assert message.checked == "front, left"
    assert message.named == {"roof"}
    roof = message.sensors["roof"]
    assert (roof.state, roof.probability, roof.moved_deg) == ("lidar_moved", 0.998, 1.0)
    assert roof.reason.startswith("It moved by 1.00°")
    assert message.edges["front"].deg == pytest.approx(0.5)
    assert message.edges["front"].sigmas == pytest.approx(5.0)
    assert message.edges["left"].sigmas == 0.0, "a pair that cannot tell is no evidence"
    unknown = snapshot_of(reply_before_checks(), START_NS, [], {}, sensors_of)
    assert (unknown.sensors["roof"].state, unknown.sensors["roof"].probability, unknown.edges) == ("unknown", 0.0, {})


SMALL = Scenario(camera_px=64, longest_s=1.0)


def without_a_service(monkeypatch: pytest.MonkeyPatch, client: type) -> None:
    """`coec demo --rig` plays small drives, and what a client of this class receives."""
    monkeypatch.setattr(rig, "RigClient", client)
    monkeypatch.setattr(rig, "serving", lambda *_: nullcontext(SimpleNamespace(until_ready=lambda: None)))
    monkeypatch.setattr(rig, "driving", lambda _: nullcontext(vehicle_of(LazyExecutor(), SMALL)))


def test_an_act_that_fails_is_an_exit_status(coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent:
        """Tells of nothing but calm."""

        def __init__(self, *_: object) -> None:
            pass

        def send(self, frames: InstantFrames) -> list[RigSnapshot]:
            return [reported(frames.second)]

        def finish(self) -> list[RigSnapshot]:
            return [reported(SMALL.longest_s)]

    without_a_service(monkeypatch, Silent)
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path)
    assert outcome.status == 1
    assert [act["knocked"] for act in outcome.document["acts"]] == ["roof", "left"]
    assert not outcome.document["passed"]
    assert all(Path(path).stat().st_size > 0 for path in outcome.document["files"])


@pytest.mark.fault("a service that checks nothing", "said in a sentence, and no page is written")
def test_a_service_that_is_uninformative_is_an_error(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Mute:
        def __init__(self, *_: object) -> None:
            pass

        def send(self, _: InstantFrames) -> list[RigSnapshot]:
            return []

        def finish(self) -> list[RigSnapshot]:
            return []

    without_a_service(monkeypatch, Mute)
    outcome = coec("demo", "--rig", "--output", tmp_path / "demo")
    assert outcome.status != 0
    assert "checked none of its pairs" in outcome.err
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
@pytest.mark.fault(
    "a LiDAR, and on another drive a camera, is knocked by 1°", "that sensor alone is named, within a minute"
)
def test_a_displaced_lidar_and_a_displaced_camera_are_distinguished(
    coec: Coec, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    outcome = coec("demo", "--rig", "--json", "--output", tmp_path / "demo")
    document = outcome.document
    assert outcome.status == 0, [act["objections"] for act in document["acts"]]
    delays_s = [act["named_s"] - act["knock_s"] for act in document["acts"]]
    assert all(0.0 < delay_s <= 60.0 for delay_s in delays_s)
    record_property("figure", " and ".join(f"{delay_s:.0f} s" for delay_s in delays_s) + " of driving")
