"""The parts of the demonstration that need no service: what counts as a story that came true, pace, view, page."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import cv2
import pytest
from rich.console import Console

from cli.conftest import Coec
from coec.calibration.types import EgoMotion
from coec.config import WindowConfig
from coec.reports.page import render
from coec.schemas import replies
from coec_lab.demo import pair_client, pair_report
from coec_lab.demo.pair import BARS, Screen, curve, view
from coec_lab.demo.pair_client import (
    LEAD_NS,
    NS_PER_S,
    STEP_NS,
    Moment,
    Pace,
    PairOutcome,
    PairVehicle,
    Snapshot,
    at_rest,
    outcome_of,
    paced,
    with_alarm,
)
from coec_lab.demo.pair_report import demo_page
from reports.pages import MADE
from support.messages import status_reply

pytestmark = pytest.mark.usefixtures("streets")

KNOCK_S, MAX_ERROR_DEG = pair_client.KNOCK_S, pair_client.MAX_ERROR_DEG

START = Moment(
    t_s=3.0, drive_s=0.0, service="running", health="unknown", provenance="nominal", status="not_accepted",
    window_id=None,
    correction_deg=(0.0, 0.0, 0.0), error_by_axis_deg=(0.0, 0.0, 0.0), error_deg=0.9,
)  # fmt: skip
HEALTHY = replace(
    START, drive_s=28.0, health="healthy", provenance="estimated", status="accepted", window_id="w-1", error_deg=0.04
)
DISPLACED = replace(HEALTHY, drive_s=36.2, error_deg=3.01)
SUSPECT = replace(DISPLACED, drive_s=46.0, health="suspect")
ALARM = replace(DISPLACED, drive_s=51.0, health="miscalibrated")
REPAIRED = replace(HEALTHY, drive_s=61.0, window_id="w-2", error_deg=0.06)


def outcome(*moments: Moment) -> PairOutcome:
    return outcome_of(moments, KNOCK_S, MAX_ERROR_DEG)


def test_a_story_that_arrived_true() -> None:
    result = outcome(START, HEALTHY, DISPLACED, SUSPECT, ALARM, REPAIRED)
    assert result.passed
    assert (result.alarm_s, result.repaired_s, result.false_alarm_s) == (51.0, 61.0, None)
    assert (result.error_before_deg, result.error_after_deg) == (3.01, 0.06)


def test_an_alarm_at_the_calibration_of_the_workshop_is_no_false_one() -> None:
    result = outcome(START, replace(START, drive_s=11.0, health="miscalibrated"), HEALTHY, DISPLACED, ALARM, REPAIRED)
    assert result.passed


def test_an_alarm_that_arrived_and_went_between_two_observations_is_in_the_story() -> None:
    seen = [START, HEALTHY, DISPLACED, SUSPECT, REPAIRED]
    result = outcome(*with_alarm(seen, 50.0))
    assert result.passed
    assert (result.alarm_s, result.repaired_s, result.error_before_deg) == (50.0, 61.0, 3.01)


@pytest.mark.parametrize(
    ("moments", "complaint"),
    [
        ((START, HEALTHY, DISPLACED), "never detected"),
        ((START, HEALTHY, DISPLACED, SUSPECT, REPAIRED), "never detected"),
        ((START, HEALTHY, DISPLACED, ALARM), "did not correct"),
        ((START, HEALTHY, DISPLACED, ALARM, replace(REPAIRED, error_deg=0.31)), "did not correct"),
        ((START, HEALTHY, DISPLACED, ALARM, REPAIRED, replace(REPAIRED, error_deg=0.31)), "did not correct"),
        ((START, HEALTHY, DISPLACED, ALARM, replace(REPAIRED, provenance="nominal")), "did not correct"),
        ((START, HEALTHY, DISPLACED, ALARM, REPAIRED, replace(REPAIRED, health="degraded")), "degraded at the end"),
        (
            (START, HEALTHY, replace(ALARM, drive_s=30.0, error_deg=0.04), DISPLACED, ALARM, REPAIRED),
            "before the displacement",
        ),
    ],
)
def test_a_story_that_did_not(moments: tuple[Moment, ...], complaint: str) -> None:
    result = outcome(*moments)
    assert not result.passed
    assert complaint in " ".join(result.failures())


def frames(count: int) -> Iterator[EgoMotion]:
    for second in range(count):
        yield EgoMotion((second + 1) * NS_PER_S, "ego", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_the_drive_waits_for_the_service() -> None:
    refusals = {3 * NS_PER_S: 2, 5 * NS_PER_S: 1}
    requested: list[int] = []

    def may_pass(stamp_ns: int) -> bool:
        requested.append(stamp_ns // NS_PER_S)
        refusals[stamp_ns] = refusals.get(stamp_ns, 0) - 1
        return refusals[stamp_ns] < 0

    sent = [frame.stamp_ns // NS_PER_S for frame in paced(frames(6), may_pass, threading.Event(), rate=1e9)]
    assert sent == [1, 2, 3, 4, 5, 6]
    assert requested == [1, 2, 3, 3, 3, 4, 5, 5, 6]


def test_the_drive_ends_when_it_is_reported() -> None:
    stop = threading.Event()
    stop.set()
    assert len(list(paced(frames(30), lambda _: False, stop, rate=1e-9))) == 30, "no wait is left"


def test_a_drive_waits_for_a_service_at_work() -> None:
    pace = Pace(judged_ns=0)
    pace.update(None, at_rest=False, stamp_ns=LEAD_NS)
    assert pace.may_pass(LEAD_NS)
    assert not pace.may_pass(LEAD_NS + 1)
    pace.update(5 * NS_PER_S, at_rest=False, stamp_ns=LEAD_NS)
    assert pace.may_pass(LEAD_NS + 5 * NS_PER_S)
    assert not pace.may_pass(LEAD_NS + 5 * NS_PER_S + 1)


def test_a_service_that_waits_for_more_gets_a_little_more() -> None:
    pace = Pace(judged_ns=0)
    pace.update(None, at_rest=True, stamp_ns=LEAD_NS)
    assert pace.may_pass(LEAD_NS + STEP_NS)
    assert not pace.may_pass(LEAD_NS + STEP_NS + 1)
    pace.update(None, at_rest=True, stamp_ns=NS_PER_S)
    assert pace.may_pass(LEAD_NS + STEP_NS), "never less than before"


@pytest.mark.parametrize(
    ("state", "queued", "held", "received", "lost", "rests"),
    [
        ("idle", 0, 0, 20, 0, True),
        ("idle", 0, 0, 19, 0, True),
        ("idle", 0, 0, 18, 0, False),
        ("idle", 0, 0, 17, 2, True),
        ("busy", 0, 0, 20, 0, False),
        ("starting", 0, 0, 20, 0, False),
        ("idle", 1, 0, 20, 0, False),
        ("idle", 0, 1, 20, 0, False),
    ],
)
def test_a_service_rests_that_has_everything_and_no_work(
    state: Literal["starting", "idle", "busy"], queued: int, held: int, received: int, lost: int, rests: bool
) -> None:
    worker = replies.WorkerStatus(state=state, queued=queued)
    camera = replies.StreamStatus(received=received, losses={"overrun": lost})
    assert at_rest(worker, replies.PairStatus(name="sim", camera=camera, held=held), sent=20) is rests


def test_a_service_does_not_rest_while_an_answer_is_pending() -> None:
    """A window is with the recorder, say: it waits neither for the worker nor for its turn."""
    pair = replies.PairStatus(name="sim", camera=replies.StreamStatus(received=20), unanswered=1)
    assert not at_rest(replies.WorkerStatus(state="idle"), pair, sent=20)


def test_the_curve_has_the_height_of_the_error_and_the_colour_of_the_health() -> None:
    text = curve([(0.0, 0.0, "unknown"), (1.0, 3.0, "miscalibrated"), (3.0, 0.1, "healthy")])
    assert text.plain == f"{BARS[0]}{BARS[7]} {BARS[0]}"
    assert [str(span.style) for span in text.spans] == ["dim", "bold red", "bold green"]
    assert len(curve([(float(second), 0.0, "healthy") for second in range(500)], width=40).plain) <= 40
    assert curve([]).plain == ""


def test_the_page_needs_no_other_file() -> None:
    moments = [START, HEALTHY, DISPLACED, ALARM, REPAIRED]
    text = document_of(moments)
    assert "src=" not in text
    assert "detected and corrected" in text
    assert re.findall(r'href="(?!#)', text) == []
    for moment in moments:
        assert f"{moment.error_deg:.3f}°" in text
    assert "never detected" in document_of(moments[:3])
    assert "error of the thing" in text


def document_of(moments: Sequence[Moment]) -> str:
    """The document."""
    series = [(moment.drive_s, moment.error_deg, moment.health) for moment in moments]
    happened = [(moment, "") for moment in moments]
    summary = [("error of the thing", "1°")]
    return render(demo_page("A mount", series, happened, summary, outcome(*moments), None, None, None, MADE))


def test_the_summary_says_when_what_happened(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr("coec.reports.console.out", Console(file=stream, width=140))
    moments = [START, HEALTHY, DISPLACED, replace(SUSPECT, drive_s=ALARM.drive_s), ALARM, REPAIRED]
    pair_report.show(moments, outcome(*moments), pair_report.WrittenFiles((), None))
    reported = stream.getvalue()
    for error in ("0.900°", "0.040°", "3.010°", "0.060°"):
        assert error in reported
    assert "15 s after it" in reported
    assert "25 s after it" in reported
    (alarm,) = (line for line in reported.splitlines() if line.rstrip().endswith("alarm"))
    assert "miscalibrated" in alarm, "not the line before, of the same second"
    for what in ("displaced", "alarm", "corrected", "accepted"):
        assert what in reported


def test_the_service_is_configured_as_on_a_vehicle_but_for_the_haste() -> None:
    pytest.importorskip("embreex", reason="needs ray casting")
    from coec_lab.simulation.drive import SimulatedDrive

    drive = SimulatedDrive(replace(pair_client.drive_config(), seconds=2.0))
    config = pair_client.service_config(drive.rig, Path("mask.png"), "tcp/127.0.0.1:1")
    (pair,) = config.pairs
    assert pair.calibration.objective.kind == "fused"
    assert pair.calibration == type(pair.calibration)(), "with the network that comes with it"
    assert (pair.policy, pair.tracker) == (type(pair.policy)(), type(pair.tracker)())
    left, top, width, height = pair_client.CLOSE_UP_PX
    assert left + width <= drive.rig.camera.width
    assert top + height <= drive.rig.camera.height


def test_there_is_something_to_check_before_the_service_reports_anything(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="needs ray casting")
    from coec_lab.simulation.drive import SimulatedDrive

    drive = SimulatedDrive(replace(pair_client.drive_config(), seconds=2.0, camera="fisheye160", lidar="16"))
    picture, page = pair_report.write_first(tmp_path, drive)
    seen = cv2.imread(str(picture))
    assert seen is not None
    assert float(seen.std()) > 10.0
    result = page.read_text()
    assert "Under way" in result
    assert "data:image/" in result
    assert page.name == pair_client.REPORT, "the report takes its place"


def check_files(document: Any) -> list[Path]:
    """What the demonstration left. Returns the window that it fetched, if one was accepted, which it then pictures."""
    written = [Path(path) for path in document["files"]]
    assert all(path.stat().st_size > 0 for path in written)
    assert (written[0].parent / f"{pair_report.PICTURE}.png").stat().st_size > 0
    windows = [path for path in written if path.suffix == ".mcap"]
    pictures = {"overlay_before.png", "overlay_after.png"} if windows else set()
    assert {"timeline.png", "report.html"} | pictures <= {path.name for path in written}
    return windows


def test_a_drive_that_ends_before_the_first_window_ends_as_one_that_did_not_come_true(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service, the vehicle, the view, the pictures, the page: all but a calibration."""
    pytest.importorskip("embreex", reason="needs ray casting")
    from coec_lab.simulation.drive import DriveConfig

    brief = DriveConfig(
        seed=pair_client.SEED, seconds=4.0, camera="fisheye160", lidar="16", camera_hz=1.0, lidar_hz=1.0, ego_hz=2.0,
        workshop=pair_client.WORKSHOP,
    )  # fmt: skip
    monkeypatch.setattr(pair_client, "drive_config", lambda: brief)
    monkeypatch.setattr(pair_client, "RENDERERS", 1)
    monkeypatch.setattr(pair_client, "CLOSE_UP_PX", tuple(value * 160 // 700 for value in pair_client.CLOSE_UP_PX))
    vehicles: list[PairVehicle] = []

    class Watched(PairVehicle):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            vehicles.append(self)

    monkeypatch.setattr("coec_lab.demo.pair.PairVehicle", Watched)
    outcome = coec("demo", "--json", "--output", tmp_path / "demo")
    assert outcome.status == 1
    assert [vehicle.pictures for vehicle in vehicles] == [4]
    document = outcome.document
    assert document["objections"] == ["The service never detected the displacement."]
    assert {(moment["health"], moment["provenance"]) for moment in document["timeline"]} == {("unknown", "nominal")}
    assert check_files(document) == []


@pytest.mark.slow
def test_a_short_drive_without_a_knock_is_calibrated_and_ends_as_one_that_did_not_come_true(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything but the knock, in pictures as small as `fused` can do with: the service, the vehicle, the view, the
    pictures, the page."""
    pytest.importorskip("embreex", reason="needs ray casting")
    from coec_lab.simulation.drive import DriveConfig

    # So long that it cannot be over before the window has been judged: see `pace.LEAD_NS`.
    quiet = DriveConfig(
        seed=pair_client.SEED, seconds=32.0, camera="fisheye600", lidar="64", camera_hz=1.0, lidar_hz=1.0, ego_hz=2.0,
        workshop=pair_client.WORKSHOP,
    )  # fmt: skip
    monkeypatch.setattr(pair_client, "drive_config", lambda: quiet)
    monkeypatch.setattr(pair_client, "WINDOW", WindowConfig(pairs=12, min_pairs=8, slice_s=12.0))
    monkeypatch.setattr(pair_client, "CLOSE_UP_PX", tuple(value * 6 // 7 for value in pair_client.CLOSE_UP_PX))
    outcome = coec("demo", "--json", "--output", tmp_path / "demo")
    assert outcome.status == 1
    document = outcome.document
    assert not document["passed"]
    assert document["objections"] == ["The service never detected the displacement."]
    first, last = document["timeline"][0], document["timeline"][-1]
    assert (first["health"], first["provenance"]) == ("unknown", "nominal")
    assert (last["health"], last["provenance"], last["status"]) == ("healthy", "estimated", "accepted")
    assert last["error_deg"] < MAX_ERROR_DEG < first["error_deg"]
    assert [path.stem for path in check_files(document)] == [last["window_id"]]


@pytest.mark.slow
def test_the_knock_is_noticed_and_repaired(coec: Coec, tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="needs ray casting")
    outcome = coec("demo", "--json", "--output", tmp_path / "demo")
    document = outcome.document
    assert outcome.status == 0, document["objections"]
    assert document["passed"]
    assert document["error_after_deg"] < MAX_ERROR_DEG < 2.5 < document["error_before_deg"]
    assert document["knock_s"] < document["alarm_s"] <= document["repaired_s"]
    states = [moment["health"] for moment in document["timeline"]]
    assert states[0] == "unknown"
    assert states[-1] == "healthy"
    assert "miscalibrated" in states
    (window,) = check_files(document)
    assert coec("replay", window).status == 0


def seen_with(worker: str, t_s: float) -> Snapshot:
    """What a client sees while the worker of the service is in this state."""
    status = status_reply(
        worker=replies.WorkerStatus.model_validate({"state": worker}), pairs=(replies.PairStatus(name="sim"),)
    )
    health: Any = SimpleNamespace(reasons=(), metrics={})
    extrinsic: Any = SimpleNamespace()
    return Snapshot(replace(START, t_s=t_s), status, health, extrinsic)


def test_a_first_run_reports_that_it_compiles_and_then_reports_the_story(capsys: pytest.CaptureFixture[str]) -> None:
    watch: Any = SimpleNamespace(series=[])
    screen = Screen()
    for t_s in (3.0, 10.0, 30.0):
        screen.show(watch, seen_with("starting", t_s))
    screen.show(watch, seen_with("idle", 35.0))
    reported = capsys.readouterr().err.splitlines()
    assert len(reported) == 2
    assert "compiling the kernels, once on this machine" in reported[0]
    assert "0.0 s of driving: unknown, nominal" in reported[1]


def test_the_live_view_says_why_the_drive_does_not_begin() -> None:
    watch: Any = SimpleNamespace(series=[])
    shown = Console(width=140, file=io.StringIO())
    with shown.capture() as before:
        shown.print(view(watch, seen_with("starting", 23.0)))
    assert "waits: kernels compile, once, for about a minute; 23 s so far" in before.get()
    with shown.capture() as after:
        shown.print(view(watch, seen_with("idle", 36.0)))
    assert "compiled" not in after.get()
