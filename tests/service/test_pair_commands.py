"""Commands do what they answer: each in each state, whole or not at all."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast
from unittest.mock import create_autospec

import numpy as np
import pytest

from coec.calibration.baseline import learned_hash
from coec.config import AuthorityConfig, UplinkConfig
from coec.geometry import se3
from coec.io.rig_files import save_baseline
from coec.io.zenoh.bus import Bus, Request, Route
from coec.schemas.keys import COMMAND_TIMEOUT_MS, Keys
from coec.service.api import command_execution
from coec.service.api.authorization import Authority, CommandHandler, CommandRules
from coec.service.api.reply_builders import SerializedReply
from coec.service.api.rig_answers import RigAnswers
from coec.service.api.routes import VehicleReplies, VehicleRoutes
from coec.service.api.uplink import Heartbeats, Uplink
from coec.service.engine.messages import CommissioningSubject, JobDone
from coec.service.worker.worker_jobs import Commissioned, Fate, JobOutcome, Kind, WorkerJob
from support.estimates import a_baseline
from support.vehicles import BEGIN_S, DRIVE_END_S, STEP_S, OracleWorker, PairBench


def test_a_roll_back_on_a_commissioned_rig_serves_what_was_served_to_the_byte(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    made = a_baseline()
    bias = np.radians([0.3, -0.2, 0.1, np.nan, np.nan, np.nan])
    commissioned = replace(
        made,
        config_hash=learned_hash(bench.config.pairs[0].calibration),
        depth_identity="precomputed",
        rotation=replace(made.rotation, bias=bias),
    )
    save_baseline(bench.folder / "rig.json", commissioned)
    bench.restart()
    bench.drive(BEGIN_S, BEGIN_S + 60)
    first = bench.pose.copy()
    raw = bench.answers.history(0, 2**63 - 1, 10).results[0]
    off = se3.difference(first, np.array(raw.camera_from_lidar.matrix))
    assert np.abs(off[:3]).max() > np.radians(0.2), "the estimator's bias was taken out of what is served"
    bench.drive(STEP_S, DRIVE_END_S)
    assert not np.array_equal(bench.pose, first)
    assert bench.do("rollback", to=raw.window_id) == "rolled_back"
    assert bench.pose.tobytes() == first.tobytes()


ORDERS: list[tuple[str, dict[str, Any]]] = [
    ("calibrate", {}),
    ("apply", {}),
    ("rollback", {}),
    ("reset", {}),
    ("commission", {}),
    ("hold", {}),
    ("hold", {"release": True}),
]
ANSWERS = {
    # What is answered to these, in this order, by what the pair has been through.
    "nothing": ["too_few_pairs", "nothing_pending", "not_found", "reset", "too_few_windows", "held", "released"],
    "healthy": ["window_again", "nothing_pending", "not_found", "reset", "commissioning", "held", "released"],
    "suspect": ["window_again", "nothing_pending", "not_found", "reset", "commissioning", "held", "released"],
    "corrected": ["window_finished", "nothing_pending", "rolled_back", "reset", "commissioning", "held", "released"],
    "pending": ["window_finished", "applied", "not_found", "reset", "commissioning", "held", "released"],
    "held": ["window_finished", "held", "held", "held", "commissioning", "held", "released"],
    "degraded": ["window_again", "nothing_pending", "not_found", "reset", "commissioning", "held", "released"],
}


def brought_to(situation: str, folder: Path) -> PairBench:
    bench = PairBench(folder, apply="never" if situation == "pending" else "within_limits")
    if situation != "nothing":
        bench.drive(BEGIN_S, BEGIN_S + 43)
    if situation == "suspect":
        bench.drive(STEP_S, STEP_S + 11)
    if situation in ("corrected", "held", "pending"):
        bench.drive(STEP_S - 20, STEP_S + 60)
    if situation == "held":
        bench.do("hold")
    if situation == "degraded":
        bench.worker.cause = "dark"
        bench.drive(BEGIN_S + 43, BEGIN_S + 56)
        bench.worker.cause = None
    return bench


@pytest.mark.parametrize("order", range(len(ORDERS)), ids=lambda i: f"{ORDERS[i][0]}-{i}")
@pytest.mark.parametrize(
    "situation",
    [
        *("nothing", "healthy", "corrected", "pending", "held"),
        # What is answered is the same as of a healthy pair.
        *(pytest.param(situation, marks=pytest.mark.slow) for situation in ("suspect", "degraded")),
    ],
)
def test_each_command_in_each_state(tmp_path: Path, situation: str, order: int) -> None:
    bench = brought_to(situation, tmp_path / "state")
    if situation in ("suspect", "degraded"):
        assert bench.health == situation
    name, arguments = ORDERS[order]
    before, pose = bench.store.state, bench.pose.copy()
    code = bench.do(name, **arguments)
    assert code == ANSWERS[situation][order]
    written = bench.entries("command")
    assert [(entry.code, entry.sender) for entry in written if entry.sender == "the test"][-1] == (code, "the test")
    refused = code in ("nothing_pending", "not_found", "too_few_pairs", "too_few_windows")
    if refused or (code, name) == ("held", "reset"):
        assert bench.pose.tobytes() == pose.tobytes()
        assert bench.store.state.health is before.health
    if code in ("reset", "rolled_back"):
        assert bench.health == "unknown", "nobody has looked at it since"
    if name == "hold":
        assert (bench.store.state.hold is not None) is (code == "held")


def test_who_holds_it_and_why_is_reported_wherever_one_requests_also_after_a_restart(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    assert bench.do("hold", reason="the mirror is being changed") == "held"
    for _ in range(2):
        extrinsic, health = bench.answers.extrinsic_reply, bench.answers.health_reply
        assert extrinsic.hold is not None
        assert (extrinsic.held, extrinsic.hold.sender) == (True, "the test")
        assert extrinsic.hold.reason == "the mirror is being changed"
        (reported,) = (reason.text for reason in health.reasons if reason.code == "held")
        assert "the test" in reported
        assert reported.endswith("the mirror is being changed.")
        assert bench.entries("command")[-1].reason == "the mirror is being changed"
        bench.restart()
    assert bench.do("calibrate", reason="to see") == "too_few_pairs"
    assert bench.entries("command")[-1].reason == "to see"
    assert bench.do("hold", release=True) == "released"
    assert bench.answers.extrinsic_reply.hold is None
    assert bench.entries("command")[-1].reason is None


@pytest.mark.fault("a `calibrate` that is refused as busy", "it changes nothing")
def test_a_calibrate_that_is_refused_as_busy_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, BEGIN_S + 30)
    selected = bench.pair.stream.report.selection.selected
    assert selected >= 5
    monkeypatch.setattr(command_execution, "TIMEOUT_S", 0.0)
    report = bench.pair.commands.carry_out("calibrate", {}, "the test")
    assert (report.accepted, report.code) == (False, "busy")
    bench.settle()
    assert (bench.pair.stream.report.selection.selected, bench.recorder.recorded) == (selected, 0)
    assert bench.answers.status().commands == {"calibrate_refused": 1}


@pytest.mark.fault("more commands than a book of the history holds", "`rollback` and `commission` find what they need")
def test_a_flood_of_commands_pushes_nothing_out_that_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_execution, "BURST", 10_000)
    bench = PairBench(tmp_path / "state")
    bench.config = bench.config.model_copy(update={"state": bench.config.state.model_copy(update={"history": 12})})
    bench.restart()
    bench.drive(BEGIN_S, DRIVE_END_S)
    results, first = bench.store.history.results(), bench.entries("extrinsic")[0]
    corrected = bench.pose.copy()
    for _ in range(10):
        codes = [bench.do("hold"), bench.do("hold", release=True), bench.do("reset"), bench.do("calibrate")]
        assert codes[:3] == ["held", "released", "reset"]
    retained = bench.store.history.results()
    assert all(result in retained for result in results)
    bench.restart()
    assert bench.do("rollback", to=first.window_id) == "rolled_back"
    assert first.camera_from_lidar is not None
    assert bench.pose.tolist() == [list(row) for row in first.camera_from_lidar.matrix]
    assert bench.do("rollback", to=results[-1].window_id) == "rolled_back"
    assert bench.pose.tobytes() == corrected.tobytes()
    assert bench.do("commission") == "commissioning"


def test_windows_that_a_pair_was_commissioned_from_are_retained_for_that_across_a_restart(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, BEGIN_S + 90)
    first, *others = [result.window_id for result in bench.store.history.results()]
    report = JobOutcome(Fate.RESULT, Commissioned(bench.pose, "0123abcd", 1, 10), None, 1.0)
    bench.pair.on_event(JobDone(CommissioningSubject((first,)), report))
    bench.settle()

    def retained_for() -> dict[str, str | None]:
        bench.context.folder.scan()
        return {info.window_id: info.kept_for for info in bench.context.folder.listing("front")}

    before = retained_for()
    assert before[first] == "commissioning"
    assert {before[name] for name in others} == {None}
    bench.restart()
    assert retained_for() == before


class CommissioningWorker(OracleWorker):
    """Has a commissioning under way for as long as the test wants."""

    def __init__(self) -> None:
        super().__init__()
        self.jobs: list[WorkerJob] = []

    def commissioning(self, pair: str) -> str | None:
        return "spread 4 of 10" if any(job.pair == pair for job in self.jobs) else None

    def submit(self, job: WorkerJob) -> None:
        if job.kind is Kind.COMMISSION:
            self.jobs.append(job)
        else:
            super().submit(job)

    def end(self, answer: Commissioned) -> None:
        self.jobs.pop().done(JobOutcome(Fate.RESULT, answer, None, 100.0))


def commissioning(folder: Path) -> tuple[PairBench, CommissioningWorker]:
    bench = PairBench(folder, worker=CommissioningWorker)
    bench.drive(BEGIN_S, BEGIN_S + 90)
    assert bench.do("commission") == "commissioning"
    return bench, cast("CommissioningWorker", bench.worker)


@pytest.mark.fault("`commission` while a commissioning of the pair runs", "refused, with how far that is")
def test_a_pair_is_commissioned_once_at_a_time(tmp_path: Path) -> None:
    bench, worker = commissioning(tmp_path / "state")
    report = [bench.do("commission") for _ in range(3)]
    assert report == ["commissioning_underway"] * 3
    assert len(worker.jobs) == 1
    assert "(spread 4 of 10)" in bench.entries("command")[-1].text
    held = bench.context.folder._held
    assert set(held) == {Path(path).stem for path in worker.jobs[0].body["paths"]}, "its windows are not removed"
    worker.end(Commissioned(bench.pose, "0123abcd", 1, 10))
    bench.settle()
    assert (bench.store.state.provenance.value, len(bench.entries("commissioned"))) == ("commissioned", 1)
    assert not held
    assert bench.do("commission") == "commissioning"


@pytest.mark.fault("the extrinsic is replaced during a commissioning", "what is served does not count as commissioned")
def test_a_commissioning_of_an_extrinsic_that_was_replaced_says_nothing_of_the_new_one(tmp_path: Path) -> None:
    bench, worker = commissioning(tmp_path / "state")
    commissioned = bench.pose.copy()
    assert bench.do("reset") == "reset"
    before = bench.store.state
    worker.end(Commissioned(commissioned, "0123abcd", 1, 10))
    bench.settle()
    after = bench.store.state
    assert not np.array_equal(after.T_camera_lidar, commissioned)
    assert (after.provenance, after.proven, after.health) == (before.provenance, before.proven, before.health)


@pytest.mark.fault("commands faster than a person gives them", "they are answered, and do nothing")
def test_commands_that_come_too_fast_are_answered_and_do_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # However long they take here, they come at once.
    monkeypatch.setattr(command_execution, "RateLimit", partial(command_execution.RateLimit, clock=lambda: 0.0))
    bench = PairBench(tmp_path / "state")
    codes = [bench.do("hold") for _ in range(command_execution.BURST)]
    assert set(codes) == {"held"}
    before = bench.store.history.entries()
    report = [bench.pair.commands.carry_out("hold", {"release": True}, "the test") for _ in range(5)]
    assert {(one.accepted, one.code) for one in report} == {(False, "too_many")}
    assert bench.store.state.hold is not None
    assert bench.store.history.entries() == before
    assert bench.answers.status().commands == {"hold_accepted": command_execution.BURST, "hold_refused": 5}


def route_of(bench: PairBench, command: str) -> Route:
    """Who answers the command."""
    keys, pair, unasked = Keys("coec", "test"), bench.pair, SerializedReply(b"", b"")
    bus = create_autospec(Bus, instance=True)
    command_handler = CommandHandler(
        CommandRules(Authority(AuthorityConfig(), lambda: None), None), {pair.name: pair.commands}
    )
    VehicleRoutes(
        keys,
        {pair.name: pair.answers},
        command_handler,
        VehicleReplies(unasked, unasked),
        lambda: b"",
        RigAnswers(keys, lambda *_: None),
        Heartbeats(keys, "0", UplinkConfig(), lambda *_: None),
        Uplink(UplinkConfig()),
    ).declare(bus)
    finders = {call.args[0]: call.args[1] for call in bus.serve.call_args_list}
    (route,) = finders[f"{keys.root}/{pair.name}/**"](keys.command(pair.name, command))
    assert isinstance(route, Route)
    return route


@pytest.mark.fault("a command whose sender has given up", "it is not done")
@pytest.mark.parametrize("name", ["hold", "calibrate"])
def test_what_its_sender_has_given_up_on_is_not_done(tmp_path: Path, name: str) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, BEGIN_S + 30)
    selected, entries = bench.pair.stream.report.selection.selected, len(bench.entries("command"))
    route = route_of(bench, name)
    arrived_s = time.monotonic() - COMMAND_TIMEOUT_MS / 1e3
    for parameters, received_s in (
        ("", arrived_s),
        ("timeout_ms=500", time.monotonic() - 0.5),
        ("timeout_ms=20", None),
    ):
        received_s = time.monotonic() if received_s is None else received_s  # nobody gets to it for 20 ms
        answer = route.answer(Request(route.key, f"format=json;{parameters}", b"", received_s))
        assert (json.loads(answer.payload)["accepted"], json.loads(answer.payload)["code"]) == (False, "expired")
    bench.settle()
    assert bench.store.state.hold is None
    assert (bench.pair.stream.report.selection.selected, bench.recorder.recorded) == (selected, 0)
    assert len(bench.entries("command")) == entries
    assert bench.answers.status().commands == {f"{name}_refused": 3}
    assert bench.do("hold") == "held", "the next is done"
