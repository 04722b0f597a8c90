"""A pair from frames to decisions, with a worker that knows the truth: what is decided depends on the data alone, not
on restarts, and people have the last word."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from baselines import a_baseline
from coec.adapters.files.baseline_file import save_baseline
from coec.adapters.files.conversions import result_of
from coec.calibration.commissioning.baseline import learned_hash
from coec.calibration.frames.window import SliceEnded
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    Estimate,
    FramePair,
    ImageFormat,
    LidarFrame,
    Matrix4,
    Reason,
)
from coec.config import Config, LimitsConfig
from coec.geometry import se3
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.ingest.inbox import Call
from coec.runtime.pair import Outside, PairService
from coec.runtime.recording.recorder import Recorder
from coec.runtime.recording.window_store import WindowStore, start_ns_of
from coec.runtime.worker.messages import pack_observation, unpack_pairs
from coec.runtime.worker.supervisor import Errand, Solved, SolveJob, Worker
from coec.schemas.base import to_msgpack
from coec.schemas.keys import Keys
from coec.schemas.replies import HistoryEntry
from estimates import estimate

S = 1_000_000_000
BEGIN_S = 1_000_000
STEP_S = BEGIN_S + 100
"""When the mount moves."""

NOMINAL = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
BEFORE = se3.perturb(NOMINAL, np.radians([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
AFTER = se3.perturb(NOMINAL, np.radians([0.1, 1.0, 0.0, 0.0, 0.0, 0.0]))
WIDTH, HEIGHT = 16, 12


def truth(stamp_ns: int) -> Matrix4:
    return BEFORE if stamp_ns < STEP_S * S else AFTER


def configuration(folder: Path, apply: str = "within_limits") -> Config:
    pair = {
        "name": "front",
        "camera": {
            "key": "in/camera",
            "intrinsics": {
                "model": "pinhole",
                "width": WIDTH,
                "height": HEIGHT,
                "fx": 8.0,
                "fy": 8.0,
                "cx": 7.5,
                "cy": 5.5,
            },
        },
        "lidar": {"key": "in/lidar"},
        "ego": {"key": "in/ego"},
        "T_camera_lidar": NOMINAL.tolist(),
        "window": {
            "pairs": 10,
            "min_pairs": 5,
            "slice_s": 40.0,
            "min_sharpness": 0.0,
            "min_mean_level": 0.0,
            "max_clipped": 1.0,
            "min_points_in_view": 1,
        },
        "monitor": {"period_s": 5.0, "pairs": 5, "min_pairs": 4, "urgent_slice_s": 10.0},
        "policy": {"apply": apply},
        "calibration": {"depth": {"model": "stereo"}},
    }
    return Config.model_validate(
        {"vehicle": "test", "state": {"directory": str(folder), "min_free_bytes": 0}, "pairs": [pair]}
    )


def pair_at(stamp_ns: int) -> FramePair:
    rng = np.random.default_rng(stamp_ns % (2**32))
    image = EncodedImage(ImageFormat.MONO8, WIDTH, HEIGHT, rng.bytes(WIDTH * HEIGHT))
    cloud = np.array([[10.0, 0.0, 0.0], [20.0, 1.0, 0.5]], dtype=np.float32)
    motion = EgoMotion(stamp_ns, "ego", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return FramePair(CameraFrame(stamp_ns, "camera", image), LidarFrame(stamp_ns, "lidar", cloud), motion)


@dataclass
class KnowingWorker:
    """Answers at once, and rightly."""

    service: Callable[[], PairService]
    cause: str | None = None
    baseline_not_used: str | None = None
    fault: Reason | None = None
    estimates: dict[str, Estimate] = field(default_factory=dict)

    def check(self, errand: Errand) -> None:
        if self.fault is not None:
            errand.done(self.fault)
            return
        pairs = unpack_pairs(errand.body["frames"], LimitsConfig())
        wrong = [se3.difference(np.array(errand.body["pose"]), truth(pair.stamp_ns)) for pair in pairs]
        offset = np.mean(wrong, axis=0)
        observation = Observation(
            stamp_ns=pairs[-1].stamp_ns,
            pair_stamps_ns=tuple(pair.stamp_ns for pair in pairs),
            metrics=(),
            offset=offset,
            sigma=np.full(6, 1e-3),
            distance2=float(np.abs(offset).max() / 0.005),
            flagged=bool(np.abs(offset).max() > 0.005),
            weak=False,
            flagged_by_paper=None,
            causes=() if self.cause is None else (CAUSES[self.cause],),
        )
        errand.done({"kind": "observed", **pack_observation(observation), "baseline_not_used": self.baseline_not_used})

    def run_errand(self, errand: Errand) -> None:
        errand.done({"kind": "drawn", "jpeg": b"jpeg"} if errand.kind == "overlay" else Reason("no", "not here"))

    def solve(self, job: SolveJob) -> None:
        service = self.service()
        result = result_of(self.estimates[job.window_id], service._rig, "test")
        service.on_solved(Solved(job, to_msgpack(result), 0.1, None))


@dataclass
class SlowWorker(KnowingWorker):
    """Answers in its own time, and out of order: some of what waits, whenever it is let."""

    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    waiting: list[Callable[[], None]] = field(default_factory=list)

    def check(self, errand: Errand) -> None:
        self.waiting.append(partial(super().check, errand))

    def solve(self, job: SolveJob) -> None:
        self.waiting.append(partial(super().solve, job))

    def work(self, share: float) -> None:
        """Answer this share of the questions that wait."""
        for answer in [one for one in self.waiting if self.rng.random() < share]:
            self.waiting.remove(answer)
            answer()


class InstantRecorder:
    """Tells the worker what is in a window, the moment it ends: the truth of its pairs, or what lies between two."""

    def __init__(self, service: Callable[[], PairService], worker: KnowingWorker, folder: WindowStore) -> None:
        self.trouble = None
        self.has_room = True
        self.recorded = 0
        self.latest: Path | None = None
        self._service = service
        self._worker = worker
        self._folder = folder
        self._stamps: list[int] = []

    def use(self, configuration: object) -> None:
        """Nothing is recorded."""

    def add(self, window_id: str, pair: FramePair, T_camera_lidar: Matrix4) -> None:
        del window_id, T_camera_lidar
        self._stamps.append(pair.stamp_ns)

    def end(self, ended: SliceEnded) -> None:
        stamps, self._stamps = self._stamps, []
        if not ended.complete:
            return
        self.recorded += 1
        self.latest = self._folder.path(ended.window_id)
        self.latest.touch()
        moved = np.mean([se3.difference(truth(stamp), NOMINAL) for stamp in stamps], axis=0)
        pose = se3.perturb(NOMINAL, moved)
        made = estimate(1)
        self._worker.estimates[ended.window_id] = replace(
            made,
            window_id=ended.window_id,
            data_stamp_ns=stamps[-1],
            optimum=replace(made.optimum, T_camera_lidar=pose),
            correction=moved,
            sigma=np.array([5e-4] * 3 + [np.nan] * 3),
        )
        self._service()._on_recorded(ended.window_id, self.latest, True)


class Bench:
    """A service without threads, driven pair by pair; `restart` replaces it by one that reads the same folder."""

    def __init__(self, folder: Path, apply: str = "within_limits", worker: type[KnowingWorker] = KnowingWorker) -> None:
        self.config = configuration(folder, apply)
        self.kind = worker
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.restart()

    def restart(self) -> None:
        windows = WindowStore(self.folder / "windows", self.config.state)
        self.worker = self.kind(lambda: self.service)
        store = StateStore(self.folder, "test")
        outside = Outside(
            Keys("coec", "test"), store, windows, cast("Worker", self.worker), lambda *_: None, lambda: ()
        )
        self.service = PairService(self.config.pairs[0], self.config, outside)
        self.service.recorder = cast("Recorder", InstantRecorder(lambda: self.service, self.worker, windows))
        self.service.refresh()

    def drive(self, begin_s: int, end_s: int) -> None:
        for stamp_ns in range(begin_s * S, end_s * S, S // 2):
            self.service._take([pair_at(stamp_ns)])
            self.settle()
        if isinstance(self.worker, SlowWorker):
            self.worker.work(share=1.0)
            self.settle()

    def settle(self) -> None:
        """What the ingest thread does until there is nothing more that it may do."""
        while isinstance(item := self.service.inbox.take(0.0), Call):
            item.run()
        while self.service._may_choose():
            self.service._choose_from_next()
        if isinstance(self.worker, SlowWorker):
            self.worker.work(share=0.05)

    def do(self, name: str, **arguments: Any) -> str:
        return self.service.command(name, arguments, "the test").code

    @property
    def pose(self) -> Matrix4:
        return self.service.ledger.state.T_camera_lidar

    @property
    def health(self) -> str:
        return self.service.ledger.state.health.value

    def entries(self, *kinds: str) -> list[HistoryEntry]:
        return [kept.entry for kept in self.service.ledger.history.entries() if kept.entry.kind in kinds]

    def decisions(self) -> list[tuple[str, str]]:
        return [(entry.kind, entry.code) for entry in self.entries("state", "extrinsic")]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "state")


END_S = STEP_S + 100


def test_a_step_is_noticed_within_a_minute_and_corrected_by_the_next_window(bench: Bench) -> None:
    bench.drive(BEGIN_S, END_S)
    states = {entry.code: (entry.stamp_ns or 0) / S - STEP_S for entry in bench.entries("state")}
    assert bench.decisions() == [
        ("extrinsic", "estimated"),
        ("state", "healthy"),
        ("state", "suspect"),
        ("state", "miscalibrated"),
        ("extrinsic", "estimated"),
        ("state", "healthy"),
    ]
    assert 0 < states["suspect"] < states["miscalibrated"] < 30
    assert states["healthy"] < 60
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.health == "healthy"


def test_the_same_drive_gives_the_same_decisions(bench: Bench, tmp_path: Path) -> None:
    again = Bench(tmp_path / "again")
    for one in (bench, again):
        one.drive(BEGIN_S, END_S)
    kinds = ("estimate", "extrinsic", "state")
    timeless = [
        [e.model_copy(update={"wall_ns": 0, "previous_sha256": ""}) for e in b.entries(*kinds)] for b in (bench, again)
    ]
    assert timeless[0] == timeless[1]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_worker_that_takes_its_time_changes_no_decision(bench: Bench, tmp_path: Path, seed: int) -> None:
    slow = Bench(tmp_path / "slow", worker=SlowWorker)
    assert isinstance(slow.worker, SlowWorker)
    slow.worker.rng = np.random.default_rng(seed)
    for one in (bench, slow):
        one.drive(BEGIN_S, END_S)
    waited = 0
    while slow.service._held and waited < 1000:
        slow.worker.work(share=0.5)
        slow.settle()
        waited += 1
    slow.drive(END_S, END_S)
    told = [
        [
            e.model_copy(update={"wall_ns": 0, "previous_sha256": ""})
            for e in b.entries("estimate", "extrinsic", "state")
        ]
        for b in (bench, slow)
    ]
    assert waited > 0, "the stream waits for the worker"
    assert told[0] == told[1]
    assert slow.service.losses.snapshot() == bench.service.losses.snapshot()


def test_a_stream_that_has_waited_for_too_long_goes_on_and_says_so(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "state", worker=SlowWorker)
    for stamp_ns in range(BEGIN_S * S, (BEGIN_S + 60) * S, S // 2):
        bench.service._take([pair_at(stamp_ns)])
        while bench.service._may_choose():
            bench.service._choose_from_next()
    waiting = len(bench.service._held)
    assert waiting > 0
    assert bench.service.losses.snapshot().get(("monitor", "not_awaited")) is None
    bench.service._held._max_bytes = 0
    while bench.service._may_choose():
        bench.service._choose_from_next()
    assert len(bench.service._held) == 0
    assert bench.service.losses.snapshot()["monitor", "not_awaited"] == waiting


@pytest.mark.parametrize("restart_s", [3, 57, 100, 104, 109, 112, 116, 125, 160])
def test_a_restart_in_the_middle_changes_no_decision(bench: Bench, tmp_path: Path, restart_s: int) -> None:
    bench.drive(BEGIN_S, END_S)
    broken = Bench(tmp_path / "broken")
    broken.drive(BEGIN_S, BEGIN_S + restart_s)
    before = broken.health
    broken.service.save()
    broken.restart()
    assert broken.health == before
    broken.drive(BEGIN_S + restart_s, END_S)

    def states(one: Bench) -> list[str]:
        return [entry.code for entry in one.entries("state")]

    assert states(broken) == states(bench)
    np.testing.assert_allclose(broken.pose, bench.pose, atol=1e-9)
    assert broken.service.ledger.history.damage is None


def test_with_never_the_candidate_waits_until_a_person_applies_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "state", apply="never")
    bench.drive(BEGIN_S, END_S)
    np.testing.assert_array_equal(bench.pose, NOMINAL)
    assert bench.health == "miscalibrated"
    assert bench.entries("extrinsic") == []
    assert bench.do("apply") == "applied"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    assert bench.health == "healthy"
    assert bench.do("apply") == "nothing_pending"


def test_a_roll_back_returns_to_any_accepted_calibration(bench: Bench) -> None:
    bench.drive(BEGIN_S, END_S)
    served = bench.service.ledger.history.entries()
    first = next(kept for kept in served if kept.entry.kind == "extrinsic")
    assert bench.do("rollback", to=first.sha256[:12]) == "rolled_back"
    np.testing.assert_array_equal(bench.pose, np.array(first.entry.camera_from_lidar.matrix))  # type: ignore[union-attr]
    assert bench.health == "unknown"
    assert bench.do("rollback", to="0" * 64) == "not_found"
    assert bench.do("rollback", to=first.sha256[:4]) == "not_found"
    last = [kept for kept in served if kept.entry.kind == "estimate"][-1]
    assert bench.do("rollback", to=last.entry.window_id) == "rolled_back"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)
    bench.drive(END_S, END_S + 20)
    assert bench.health == "healthy"
    assert bench.do("reset") == "reset"
    np.testing.assert_array_equal(bench.pose, NOMINAL)


def test_hold_freezes_over_a_restart_until_it_is_released(bench: Bench) -> None:
    bench.drive(BEGIN_S, STEP_S)
    frozen = bench.pose
    assert bench.do("hold") == "held"
    bench.restart()
    bench.drive(STEP_S, END_S)
    np.testing.assert_array_equal(bench.pose, frozen)
    assert bench.health == "miscalibrated"
    window_id = bench.entries("estimate")[-1].window_id
    assert [bench.do("apply"), bench.do("rollback", to=window_id), bench.do("reset")] == ["held"] * 3
    assert bench.do("hold", release=True) == "released"
    assert bench.do("apply") == "applied"
    np.testing.assert_allclose(bench.pose, AFTER, atol=1e-9)


def test_every_command_is_written_down_but_a_flood_of_refusals_only_once(bench: Bench) -> None:
    for _ in range(50):
        bench.do("apply")
    bench.do("hold")
    entries = bench.entries("command")
    assert [(entry.code, entry.sender) for entry in entries] == [("nothing_pending", "the test"), ("held", "the test")]
    assert bench.service.status().commands == {"apply_refused": 50, "hold_accepted": 1}


def test_a_red_event_leaves_evidence(bench: Bench) -> None:
    bench.drive(BEGIN_S, END_S)
    (event,) = bench.service.evidence().events
    assert event.window_before is not None
    assert event.resolution is not None
    assert event.resolution.startswith("healthy")
    assert [reason.code for reason in event.reasons] == ["bent_mount"]
    assert event.overlays == ("before", "after")
    assert event.window_after is not None
    assert start_ns_of(event.window_before) < STEP_S * S <= start_ns_of(event.window_after)
    whole = bench.service.ledger.evidence.event(event.event_id)
    assert {point.state for point in whole.metrics} >= {"healthy", "suspect"}
    bench.restart()
    assert bench.service.ledger.evidence.event(event.event_id) == whole


def test_every_check_can_be_read_afterwards(bench: Bench) -> None:
    bench.drive(BEGIN_S, END_S)
    history = bench.service.history(0, 2**63 - 1, 1000)
    assert len(history.checks) == bench.service.status().checks > 20
    states = [check.state for check in history.checks]
    assert [state for state, before in zip(states, [None, *states], strict=False) if state != before] == [
        "unknown",
        "healthy",
        "suspect",
        "healthy",
    ], "red is the word of a window here"
    suspect = next(check for check in history.checks if check.state == "suspect")
    assert (suspect.outcome, suspect.flagged) == ("suspect", True)
    assert suspect.evidence >= 1.5
    told = bench.service.history(STEP_S * S, 2**63 - 1, 3).checks
    assert told == history.checks[-3:]
    health = bench.service.health_reply
    assert health.check == history.checks[-1]
    bench.restart()
    assert bench.service.history(0, 2**63 - 1, 1000).checks == history.checks


def test_a_monitor_that_cannot_look_is_told_and_hides_no_green(bench: Bench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    assert bench.service.health_reply.state == "healthy"
    bench.worker.fault = Reason("internal_error", "The program failed (ZeroDivisionError: division by zero).")
    bench.drive(BEGIN_S + 60, BEGIN_S + 90)
    told = bench.service.health_reply
    assert told.state == "degraded"
    (reason,) = told.reasons
    assert reason.code == "monitor_blind"
    assert "ZeroDivisionError" in reason.text
    assert bench.service.status().losses["check_internal_error"] >= 3
    assert bench.health == "healthy", "the decisions are not touched"
    bench.worker.fault = None
    bench.drive(BEGIN_S + 90, STEP_S)
    assert bench.service.health_reply.state == "healthy"


@pytest.mark.parametrize(
    ("spoilt", "word"),
    [
        ({"limits": {"min_mood": 1.0}}, "min_mood"),
        ({"config_hash": "other"}, "another configuration"),
        ({"pair": "front", "sensors": {"camera_frame": "other"}}, "the camera other"),
    ],
)
def test_a_baseline_of_something_else_is_refused_aloud(bench: Bench, spoilt: dict[str, Any], word: str) -> None:
    good = replace(
        a_baseline(), config_hash=learned_hash(bench.config.pairs[0].calibration), depth_identity="precomputed"
    )
    save_baseline(bench.folder / "rig.json", good)
    bench.restart()
    assert "baseline_mismatch" not in [one.code for one in bench.service.health_reply.reasons]
    assert bench.service.health_reply.drift is not None
    save_baseline(bench.folder / "rig.json", replace(good, **spoilt))
    bench.restart()
    (reason,) = [one for one in bench.service.health_reply.reasons if one.code == "baseline_mismatch"]
    assert word in reason.text
    assert bench.service.health_reply.drift is None


def test_a_baseline_of_another_network_is_refused_at_the_first_check(bench: Bench) -> None:
    learned = learned_hash(bench.config.pairs[0].calibration)
    save_baseline(bench.folder / "rig.json", replace(a_baseline(), config_hash=learned))
    bench.restart()
    bench.worker.baseline_not_used = "It was made with another depth network."
    bench.drive(BEGIN_S, BEGIN_S + 12)
    (reason,) = [one for one in bench.service.health_reply.reasons if one.code == "baseline_mismatch"]
    assert "another depth network" in reason.text
    assert bench.service.health_reply.drift is None


@pytest.mark.parametrize("cause", ["lens_dirty", "camera_frozen", "lidar_beams_lost", "dark"])
def test_bad_data_are_degraded_with_their_reason_and_move_nothing(bench: Bench, cause: str) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    bench.worker.cause = cause
    bench.drive(BEGIN_S + 60, STEP_S)
    assert bench.health == "degraded"
    assert [reason.code for reason in bench.service.ledger.state.reasons] == [cause]
    assert bench.service.evidence().events == ()
    bench.worker.cause = None
    bench.drive(STEP_S, END_S)
    assert bench.health == "healthy"


def test_a_chain_that_was_tampered_with_is_told_and_kept_aside(bench: Bench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 90)
    path = bench.folder / "history-front.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:2], *lines[3:]]))
    bench.restart()
    assert bench.service.losses.snapshot()["storage", "history_damaged"] == 1
    assert bench.service.ledger.damage is not None
    assert bench.service.ledger.damage.code == "history_damaged"
    assert [entry.kind for entry in bench.entries("chain")] == ["chain"]
    assert path.with_name(path.name + ".broken").exists()
    np.testing.assert_allclose(bench.pose, BEFORE, atol=1e-9)
    bench.restart()
    assert bench.service.ledger.damage is None
