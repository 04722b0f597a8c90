"""A pair from frames to decisions, with a worker that knows the truth: what is decided depends on the data alone, not
on restarts, and people have the last word."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.baseline import learned_hash
from coec.calibration.monitor.change_detector import alarm_levels
from coec.calibration.types import (
    Reason,
)
from coec.io.rig_files import save_baseline
from coec.io.serialise import matrix_of
from coec.io.storage import StateFile
from coec.service.ingest.pair_stream import PairStream
from coec.service.recording.window_store import start_ns_of
from support.estimates import a_baseline
from support.vehicles import (
    AFTER,
    BEFORE,
    BEGIN_S,
    DRIVE_END_S,
    NOMINAL,
    NS_PER_S,
    STEP_S,
    PairBench,
    SlowWorker,
    frame_pair_at,
)


@pytest.fixture
def bench(tmp_path: Path) -> PairBench:
    return PairBench(tmp_path / "state")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> PairBench:
    """After the whole drive, for comparison: nobody sends it anything more."""
    bench = PairBench(tmp_path_factory.mktemp("undisturbed") / "state")
    bench.drive(BEGIN_S, DRIVE_END_S)
    return bench


@pytest.mark.fault("the mount is knocked", "it is noticed within a minute, and corrected by the next window")
def test_a_step_is_noticed_within_a_minute_and_corrected_by_the_next_window(
    undisturbed: PairBench, record_property: Callable[[str, object], None]
) -> None:
    bench = undisturbed
    states = {entry.code: (entry.stamp_ns or 0) / NS_PER_S - STEP_S for entry in bench.entries("state")}
    assert bench.decisions() == [
        ("extrinsic", "estimated"),
        ("state", "healthy"),
        ("state", "suspect"),
        ("state", "miscalibrated"),
        ("extrinsic", "estimated"),
        ("state", "healthy"),
    ]
    record_property("figure", ", ".join(f"{state} after {at_s:.0f} s" for state, at_s in states.items() if at_s > 0))
    assert 0 < states["suspect"] < states["miscalibrated"] < 30
    assert states["healthy"] < 60
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.health == "healthy"
    alarms = bench.answers.health_reply.alarms
    assert alarms is not None
    assert (alarms.confirmed, alarms.withdrawn, alarms.open) == (1, 0, False)
    assert 0.8 * (DRIVE_END_S - BEGIN_S) < alarms.watched_s < DRIVE_END_S - BEGIN_S


def test_every_event_is_reported_to_whoever_keeps_the_seconds_around_it(
    bench: PairBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[tuple[str, float]] = []
    monkeypatch.setattr(
        PairStream, "keep_snippet", lambda _, name, pose: reported.append((name, float(np.abs(pose - AFTER).max())))
    )
    bench.drive(BEGIN_S, DRIVE_END_S)
    assert [name for name, _ in reported] == ["suspect", "miscalibrated"]
    assert min(off for _, off in reported) > 0, "with what was served when it began"


def test_the_same_drive_gives_the_same_decisions(undisturbed: PairBench, bench: PairBench) -> None:
    bench.drive(BEGIN_S, DRIVE_END_S)
    kinds = ("estimate", "extrinsic", "state")
    timeless = [
        [e.model_copy(update={"wall_ns": 0, "previous_sha256": ""}) for e in b.entries(*kinds)]
        for b in (undisturbed, bench)
    ]
    assert timeless[0] == timeless[1]


def test_a_reason_to_end_remains_while_the_pair_goes_on(bench: PairBench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    bench.answers.fail(Reason("thread_died", "The thread discovery died."))
    bench.drive(BEGIN_S + 60, BEGIN_S + 90)
    health = bench.answers.health_reply
    assert health.state != "healthy"
    assert [reason.code for reason in health.reasons].count("thread_died") == 1


def test_pairs_are_recorded_between_those_of_a_window_a_second_separate(bench: PairBench) -> None:
    bench.drive(BEGIN_S, STEP_S)
    for window_id, stamps_ns in list(bench.recorder.stamps.items())[:2]:
        between_ns = bench.recorder.between[window_id]
        assert stamps_ns[0] < between_ns[0]
        assert between_ns[-1] < stamps_ns[0] + 40 * NS_PER_S
        separation_s = np.diff(sorted([*stamps_ns, *between_ns])) / NS_PER_S
        assert separation_s.max() <= 1.5, "so far apart are two pairs, chosen or not"
        assert len(between_ns) > 2 * len(stamps_ns)


@pytest.mark.fault("a worker that is slow", "no decision changes")
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_worker_that_takes_its_time_changes_no_decision(undisturbed: PairBench, tmp_path: Path, seed: int) -> None:
    slow = PairBench(tmp_path / "slow", worker=SlowWorker)
    assert isinstance(slow.worker, SlowWorker)
    slow.worker.rng = np.random.default_rng(seed)
    slow.drive(BEGIN_S, DRIVE_END_S)
    waited = 0
    while slow.pair.stream.report.held and waited < 1000:
        slow.worker.work(share=0.5)
        slow.settle()
        waited += 1
    slow.drive(DRIVE_END_S, DRIVE_END_S)
    reported = [
        [
            e.model_copy(update={"wall_ns": 0, "previous_sha256": ""})
            for e in b.entries("estimate", "extrinsic", "state")
        ]
        for b in (undisturbed, slow)
    ]
    assert waited > 0, "the stream waits for the worker"
    assert reported[0] == reported[1]
    assert slow.losses == undisturbed.losses


def test_a_stream_that_has_waited_for_too_long_goes_on_and_says_so(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", worker=SlowWorker)
    for stamp_ns in range(BEGIN_S * NS_PER_S, (BEGIN_S + 60) * NS_PER_S, NS_PER_S // 2):
        bench.hold(frame_pair_at(stamp_ns))
        while bench.pair.advance(bench.clock.monotonic_s()):
            pass
    waiting = len(bench.pair.stream.held.pairs)
    assert waiting > 0
    assert ("monitor", "not_awaited") not in bench.losses
    bench.vehicle.waiting_frames._max_bytes = 0
    while bench.pair.advance(bench.clock.monotonic_s()):
        pass
    assert len(bench.pair.stream.held.pairs) == 0
    assert bench.losses["monitor", "not_awaited"] == waiting


@pytest.mark.fault("a restart in the middle of a drive", "no decision changes")
@pytest.mark.parametrize(
    "restart_s",
    [57, 104, 112, 125, *(pytest.param(second, marks=pytest.mark.slow) for second in (3, 100, 109, 116, 160))],
)
def test_a_restart_in_the_middle_changes_no_decision(undisturbed: PairBench, tmp_path: Path, restart_s: int) -> None:
    broken = PairBench(tmp_path / "broken")
    broken.drive(BEGIN_S, BEGIN_S + restart_s)
    before = broken.health
    broken.store.save()
    broken.restart()
    assert broken.health == ("unknown" if before == "healthy" else before), "nothing has been looked at since"
    broken.drive(BEGIN_S + restart_s, DRIVE_END_S)

    def states(one: PairBench) -> list[str]:
        reported = [entry.code for entry in one.entries("state") if entry.code != "unknown"]
        return [code for code, after in zip(reported, [*reported[1:], None], strict=True) if code != after]

    assert states(broken) == states(undisturbed)
    np.testing.assert_allclose(broken.pose, undisturbed.pose, atol=1e-9)
    assert broken.store.history.damage is None


def seeing(folder: Path) -> PairBench:
    bench = PairBench(folder)
    bench.recorder.sees_moves = True
    return bench


def with_knock(bench: PairBench) -> tuple[list[int], list[int]]:
    """Stamps of the window that holds the step, and of the one after it, in seconds since the step."""
    reported = list(bench.recorder.stamps.values())
    place = next(i for i, stamps in enumerate(reported) if stamps[0] < STEP_S * NS_PER_S <= stamps[-1])
    before, after = ([round(stamp / NS_PER_S) - STEP_S for stamp in stamps] for stamps in reported[place : place + 2])
    return before, after


def test_the_pairs_after_a_knock_are_in_the_next_window_which_comes_the_sooner(tmp_path: Path) -> None:
    bench = seeing(tmp_path / "state")
    bench.drive(BEGIN_S, STEP_S + 30)
    displaced, following = with_knock(bench)
    after = [stamp for stamp in displaced if stamp >= 0]
    assert after
    assert following[: len(after)] == after
    assert len(following) == bench.config.pairs[0].window.pairs
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.health == "healthy"


@pytest.mark.fault("killed between a knock and the end of the next window", "no pair after the knock is lost")
@pytest.mark.parametrize("after_s", [18, *(pytest.param(second, marks=pytest.mark.slow) for second in (16, 20))])
def test_a_restart_loses_no_pair_after_a_knock(tmp_path: Path, after_s: int) -> None:
    whole, broken = seeing(tmp_path / "whole"), seeing(tmp_path / "broken")
    whole.drive(STEP_S - 60, STEP_S + 30)
    displaced, _ = with_knock(whole)
    restart_s = STEP_S + after_s
    broken.drive(STEP_S - 60, restart_s)
    stamps = broken.recorder.stamps
    broken.store.save()
    broken.restart()
    broken.recorder.sees_moves, broken.recorder.stamps = True, stamps
    broken.drive(restart_s, STEP_S + 40)
    of_broken, following = with_knock(broken)
    assert of_broken == displaced
    after = [stamp for stamp in displaced if stamp >= 0]
    assert following[: len(after)] == after
    np.testing.assert_allclose(broken.pose, AFTER, atol=1e-9)


def test_what_is_retained_after_a_displacement_does_not_hang_on_when_the_worker_answers(tmp_path: Path) -> None:
    quick, slow = seeing(tmp_path / "quick"), PairBench(tmp_path / "slow", worker=SlowWorker)
    slow.recorder.sees_moves = True
    assert isinstance(slow.worker, SlowWorker)
    end_s = STEP_S + 30
    for one in (quick, slow):
        one.drive(STEP_S - 60, end_s)
    for _ in range(1000):
        if not slow.pair.stream.report.held:
            break
        slow.worker.work(share=0.5)
        slow.settle()
    slow.drive(end_s, end_s)
    assert with_knock(slow) == with_knock(quick)
    assert slow.recorder.stamps == quick.recorder.stamps


def test_with_never_the_candidate_waits_until_a_person_applies_it(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", apply="never")
    bench.drive(BEGIN_S, DRIVE_END_S)
    np.testing.assert_array_equal(bench.pose, NOMINAL)
    assert bench.health == "miscalibrated"
    assert bench.entries("extrinsic") == []
    assert bench.do("apply") == "applied"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.health == "unknown", "no check has acquitted it yet"
    assert bench.do("apply") == "nothing_pending"
    bench.drive(DRIVE_END_S, DRIVE_END_S + 10)
    assert bench.health == "healthy"


@pytest.mark.fault(
    "the candidate that a person looked at was replaced by another",
    "`apply` that names it is refused, and says which waits",
)
def test_apply_takes_the_named_candidate_and_no_other(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", apply="never")
    bench.drive(BEGIN_S, STEP_S)
    seen = bench.answers.extrinsic_reply.pending
    bench.drive(STEP_S, DRIVE_END_S)
    waits = bench.answers.extrinsic_reply.pending
    assert seen is not None
    assert waits is not None
    content = waits.window_id.encode() + b"\n" + np.array(waits.camera_from_lidar.matrix, "<f8").tobytes()
    assert waits.sha256 == hashlib.sha256(content).hexdigest() != seen.sha256
    for other in (str(seen.sha256), seen.window_id, waits.sha256[:4], ""):
        done = bench.acknowledged("apply", candidate=other)
        assert (done.accepted, done.code) == (False, "other_candidate")
        assert waits.sha256[:16] in done.text
        assert waits.window_id in done.text
    np.testing.assert_array_equal(bench.pose, NOMINAL)
    done = bench.acknowledged("apply", candidate=waits.sha256[:16])
    assert (done.code, done.window_id, waits.sha256[:16] in done.text) == ("applied", waits.window_id, True)
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.do("apply", candidate=waits.window_id) == "nothing_pending"


def test_a_roll_back_returns_to_any_accepted_calibration(bench: PairBench) -> None:
    bench.drive(BEGIN_S, DRIVE_END_S)
    served = bench.store.history.entries()
    first = next(retained for retained in served if retained.entry.kind == "extrinsic")
    assert bench.do("rollback", to=first.sha256[:12]) == "rolled_back"
    np.testing.assert_array_equal(bench.pose, np.array(first.entry.camera_from_lidar.matrix))  # type: ignore[union-attr]
    assert bench.health == "unknown"
    assert bench.do("rollback", to="0" * 64) == "not_found"
    assert bench.do("rollback", to=first.sha256[:4]) == "not_found"
    last = [retained for retained in served if retained.entry.kind == "estimate"][-1]
    assert bench.do("rollback", to=last.entry.window_id) == "rolled_back"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    bench.drive(DRIVE_END_S, DRIVE_END_S + 20)
    assert bench.health == "healthy"
    assert bench.do("reset") == "reset"
    np.testing.assert_array_equal(bench.pose, NOMINAL)


def test_hold_freezes_over_a_restart_until_it_is_released(bench: PairBench) -> None:
    bench.drive(BEGIN_S, STEP_S)
    frozen = bench.pose
    assert bench.do("hold") == "held"
    bench.restart()
    bench.drive(STEP_S, DRIVE_END_S)
    np.testing.assert_array_equal(bench.pose, frozen)
    assert bench.health == "miscalibrated"
    window_id = bench.entries("estimate")[-1].window_id
    assert [bench.do("apply"), bench.do("rollback", to=window_id), bench.do("reset")] == ["held"] * 3
    assert bench.do("hold", release=True) == "released"
    assert bench.do("apply") == "applied"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)


def test_every_command_is_written_down_but_a_flood_of_refusals_only_once(bench: PairBench) -> None:
    for _ in range(10):
        bench.do("apply")
    bench.do("hold")
    entries = bench.entries("command")
    assert [(entry.code, entry.sender) for entry in entries] == [("nothing_pending", "the test"), ("held", "the test")]
    assert bench.answers.status().commands == {"apply_refused": 10, "hold_accepted": 1}


def test_a_red_event_leaves_evidence(bench: PairBench) -> None:
    bench.drive(BEGIN_S, DRIVE_END_S)
    (event,) = bench.answers.events().events
    assert event.window_before is not None
    assert event.resolution is not None
    assert event.resolution.startswith("healthy")
    assert [reason.code for reason in event.reasons] == ["bent_mount"]
    assert event.overlays == ("before", "after")
    assert event.window_after is not None
    assert start_ns_of(event.window_before) < STEP_S * NS_PER_S <= start_ns_of(event.window_after)
    served = matrix_of(event.camera_from_lidar).tolist()
    before, after = (job for job in bench.worker.overlays if "poses" in job.body)
    assert (before.subject, after.subject) == (event.window_before, event.window_after)
    # One place, both extrinsics, the same two on either side: the first is right before, the second after.
    assert before.body["poses"] == after.body["poses"]
    assert before.body["names"] == after.body["names"]
    assert before.body["poses"][0] == served
    reported = bench.worker.estimates[event.window_after].optimum.T_camera_lidar
    np.testing.assert_allclose(before.body["poses"][1], reported, atol=1e-12)
    assert "accepted" in before.body["names"][1]
    (whole,) = (each for each in bench.store.incidents.events() if each.event_id == event.event_id)
    assert {point.state for point in whole.metrics} >= {"healthy", "suspect"}
    bench.restart()
    assert whole in bench.store.incidents.events()


def test_every_check_can_be_read_afterwards(bench: PairBench) -> None:
    bench.drive(BEGIN_S, DRIVE_END_S)
    history = bench.answers.history(0, 2**63 - 1, 1000)
    assert len(history.checks) == bench.answers.status().checks > 20
    states = [check.state for check in history.checks]
    assert [state for state, before in zip(states, [None, *states], strict=False) if state != before] == [
        "unknown",
        "healthy",
        "suspect",
        "miscalibrated",
        "healthy",
    ]
    suspect = next(check for check in history.checks if check.state == "suspect")
    assert (suspect.outcome, suspect.flagged) == ("suspect", True)
    assert suspect.evidence >= alarm_levels(bench.config.pairs[0].monitor).suspect
    reported = bench.answers.history(STEP_S * NS_PER_S, 2**63 - 1, 3).checks
    assert reported == history.checks[-3:]
    health = bench.answers.health_reply
    assert health.check == history.checks[-1]
    bench.restart()
    assert bench.answers.history(0, 2**63 - 1, 1000).checks == history.checks


@pytest.mark.fault("a monitor that cannot look", "this is reported, and nothing stays green")
def test_a_monitor_that_cannot_observe_is_reported_and_hides_no_green(bench: PairBench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    assert bench.answers.health_reply.state == "healthy"
    bench.worker.fault = Reason("internal_error", "The program failed (ZeroDivisionError: division by zero).")
    bench.drive(BEGIN_S + 60, BEGIN_S + 90)
    reported = bench.answers.health_reply
    assert reported.state == "degraded"
    (reason,) = reported.reasons
    assert reason.code == "monitor_blind"
    assert "ZeroDivisionError" in reason.text
    assert bench.answers.status().losses["check_internal_error"] >= 3
    assert bench.health == "healthy", "the decisions are not touched"
    bench.worker.fault = None
    bench.drive(BEGIN_S + 90, STEP_S)
    assert bench.answers.health_reply.state == "healthy"


@pytest.mark.parametrize(
    ("spoilt", "word"),
    [
        ({"limits": {"min_mood": 1.0}}, "min_mood"),
        ({"config_hash": "other"}, "another configuration"),
        ({"pair": "front", "sensors": {"camera_frame": "other"}}, "the camera other"),
    ],
)
def test_a_baseline_of_something_else_is_refused_aloud(bench: PairBench, spoilt: dict[str, Any], word: str) -> None:
    good = replace(
        a_baseline(), config_hash=learned_hash(bench.config.pairs[0].calibration), depth_identity="precomputed"
    )
    save_baseline(bench.folder / "rig.json", good)
    bench.restart()
    assert "baseline_mismatch" not in [one.code for one in bench.answers.health_reply.reasons]
    assert bench.answers.health_reply.drift is not None
    save_baseline(bench.folder / "rig.json", replace(good, **spoilt))
    bench.restart()
    (reason,) = [one for one in bench.answers.health_reply.reasons if one.code == "baseline_mismatch"]
    assert word in reason.text
    assert bench.answers.health_reply.drift is None


def test_a_baseline_of_another_network_is_refused_at_the_first_check(bench: PairBench) -> None:
    learned = learned_hash(bench.config.pairs[0].calibration)
    save_baseline(bench.folder / "rig.json", replace(a_baseline(), config_hash=learned))
    bench.restart()
    bench.worker.baseline_not_used = "It was made with another depth network."
    bench.drive(BEGIN_S, BEGIN_S + 12)
    (reason,) = [one for one in bench.answers.health_reply.reasons if one.code == "baseline_mismatch"]
    assert "another depth network" in reason.text
    assert bench.answers.health_reply.drift is None


@pytest.mark.fault("bad pictures: dark, blurred, covered", "degraded with the reason; the extrinsic does not move")
@pytest.mark.parametrize("cause", ["lens_dirty", "lidar_beams_lost"])
def test_bad_data_are_degraded_with_their_reason_and_move_nothing(bench: PairBench, cause: str) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    bench.worker.cause = cause
    bench.drive(BEGIN_S + 60, STEP_S)
    assert bench.health == "degraded"
    assert [reason.code for reason in bench.store.state.reasons] == [cause]
    assert bench.answers.events().events == ()
    bench.worker.cause = None
    bench.drive(STEP_S, DRIVE_END_S)
    assert bench.health == "healthy"


@pytest.mark.fault("a history that was tampered with", "health says so, and it is kept aside")
def test_a_chain_that_was_tampered_with_is_reported_and_quarantined(bench: PairBench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 90)
    path = bench.folder / "history-front.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:2], *lines[3:]]))
    bench.restart()
    assert bench.losses["storage", "history_damaged"] == 1
    assert bench.store.damage is not None
    assert bench.store.damage.code == "history_damaged"
    assert [entry.kind for entry in bench.entries("chain")] == ["chain"]
    assert path.with_name(path.name + ".broken").exists()
    np.testing.assert_allclose(bench.pose, BEFORE, atol=1e-9)
    bench.restart()
    assert bench.store.damage is None


@pytest.mark.fault("a forged state", "it is never served, and health says so")
def test_a_forged_state_is_never_served_and_reported_in_health(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, STEP_S)
    assert bench.health == "healthy"
    file = StateFile(bench.folder / "state.json")
    body = file.load().body
    assert body is not None
    body["pairs"]["front"]["T_camera_lidar"] = [[0.0] * 4] * 4
    file.save(body)
    forged = (bench.folder / "state.json").read_bytes()
    bench.restart()
    np.testing.assert_array_equal(bench.pose, NOMINAL)
    assert bench.health == "unknown"
    reply = bench.answers.health_reply
    (reason,) = [reason for reason in reply.reasons if reason.code == "state_damaged"]
    assert "no rigid transform" in reason.text
    assert "nominal" in reason.text
    assert (bench.folder / "state.json.broken").read_bytes() == forged
