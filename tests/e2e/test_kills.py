"""A service that is killed again and again under load: what it once told anybody, it knows after the next start."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.config import (
    CalibrationConfig,
    Config,
    DepthConfig,
    MonitorConfig,
    SnippetsConfig,
    WindowConfig,
    load_config,
)
from coec.io.mcap.windows import read_window
from coec.io.zenoh.player import Player, StreamKeys, repeated, shifted
from coec.io.zenoh.query_client import is_alive
from coec.reports.commented_yaml import commented_yaml
from e2e.drives import EARLY_STEPPED, NS_PER_S, Drive, rendered
from e2e.processes import PATIENCE_S, Router, Service, service, write_configuration
from support.fake_worker import wait_until

pytest.importorskip("embreex", reason="needs embreex")

SPEED = 16.0
"""Seconds of driving per second. Whenever the drive begins again the mount is back where it was: an incident twice in
each pass."""

LONGEST_S = 5.0
"""From the first answer to the kill: on two idle cores the worker is warm after two of them."""

QUERY_PERIOD_S = 0.1

SNIPPET_BYTES = 64 * 2**20
"""Of memory; some seconds of the drive."""

DAMAGE = {"state_damaged", "history_damaged"}
"""Reasons of health, and losses, that only a disk or a stranger may bring about."""


@dataclass
class Reported:
    """What the service has told a client: of each question the last answer; and whether it is held, as far as the last
    acknowledgement says that this is on the disk."""

    answers: dict[str, Any] = field(default_factory=dict)
    held: bool | None = None

    def query(self, running: Service) -> None:
        """Everything once."""
        keys, pair = running.keys, running.pair
        self.answers["extrinsic"] = running.extrinsic()
        self.answers["history"] = running.history()
        self.answers["windows"], self.answers["snippets"] = running.windows(), running.snippets()
        events = running.query(keys.evidence(pair))["events"]
        self.answers["events"] = [running.query(keys.evidence_of(pair, event["event_id"])) for event in events]

    def hold(self, running: Service, *, release: bool) -> None:
        """Has the extrinsic held, or released."""
        acknowledged = running.command("hold", b'{"release":true}' if release else b"{}")
        assert acknowledged["accepted"], acknowledged
        # Not on the disk, and said to be so, it may be done or not.
        self.held = not release if acknowledged["durable"] else None


@contextmanager
def driving(drive: Drive, router: Router) -> Iterator[None]:
    """The drive on the bus, over and over, whether somebody listens or not; sensor time never steps back."""
    player = Player(router.session, StreamKeys.default(drive.recording.rig.pair), "msgpack")
    stop = threading.Event()
    frames = repeated(lambda: drive.frames, shifted, 0, NS_PER_S, forever=True)
    thread = threading.Thread(target=player.play, args=(frames, SPEED, stop, lambda *_: None))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        player.close()


def lives(config: Path, router: Router, folder: Path, kills: int, seed: int) -> list[float]:
    """Kills a service under load so often, at seeded moments, and looks each time at what is left; seconds from start
    to first answer."""
    rng = np.random.default_rng(seed)
    reported = Reported()
    starts_s = []
    for life in range(kills + 1):
        started_s = time.monotonic()
        with service(config, router, warm=False) as running:
            running.extrinsic()
            starts_s.append(time.monotonic() - started_s)
            _check_nothing_is_lost(running, reported, folder)
            kill_s, command_s = (time.monotonic() + LONGEST_S * share for share in (rng.random(), rng.random()))
            while time.monotonic() < kill_s:
                reported.query(running)
                if time.monotonic() > command_s:
                    reported.hold(running, release=life % 2 > 0)
                    command_s = kill_s
                running.changed.wait(min(QUERY_PERIOD_S, max(kill_s - time.monotonic(), 0.0)))
                running.changed.clear()
            running.kill()
            # A busy router notices late, and whom it still announces the next one does not join.
            wait_until(lambda: not is_alive(router.session, running.keys, PATIENCE_S), "forgotten", PATIENCE_S)
    return starts_s


def _check_nothing_is_lost(running: Service, reported: Reported, folder: Path) -> None:
    assert not DAMAGE & {reason["code"] for reason in running.health()["reasons"]}
    assert not DAMAGE & set(running.counters()["losses"])
    before, now = reported.answers, Reported()
    now.query(running)
    after = now.answers
    if not before:
        return
    old, new = before["history"], after["history"]
    for kind in ("entries", "results", "checks"):
        assert new[kind][: len(old[kind])] == old[kind], kind
    fresh = new["entries"][len(old["entries"]) :]
    assert not [one for one in new["entries"] if one["entry"]["kind"] == "chain"]
    _check_windows(before["windows"], {window["window_id"]: window for window in after["windows"]}, folder)
    snippets = {one["snippet_id"]: one for one in after["snippets"]}
    for one in before["snippets"]:
        assert snippets[one["snippet_id"]] == one
    events = {event["event_id"]: event for event in after["events"]}
    for event in before["events"]:
        assert len(events[event["event_id"]]["metrics"]) >= len(event["metrics"])
        assert set(events[event["event_id"]]["overlays"]) >= set(event["overlays"])
    # What was served, or what was decided since, before anybody asked.
    poses = [before["extrinsic"]["camera_from_lidar"], *(one["entry"]["camera_from_lidar"] for one in fresh)]
    assert after["extrinsic"]["camera_from_lidar"] in poses
    if reported.held is not None:
        assert after["extrinsic"]["held"] is reported.held


def _check_windows(before: list[Any], now: dict[str, Any], folder: Path) -> None:
    for window in before:
        retained = now[window["window_id"]]
        counts = {retained["pairs"], window["pairs"], len(read_window(folder / f"{window['window_id']}.mcap")[0].pairs)}
        assert len(counts - {None}) == 1, f"pairs of {window['window_id']}: {retained}, {window}"
        assert window["decision"] in (None, retained["decision"])


@pytest.fixture
def config(tmp_path: Path, router: Router) -> Path:
    """Short windows, and snippets of incidents, so that there is always something to be written."""
    path = write_configuration(
        tmp_path,
        rendered(EARLY_STEPPED).recording,
        router.endpoint,
        window=WindowConfig(pairs=12, min_pairs=8, slice_s=12.0),
        monitor=MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=12.0),
        calibration=CalibrationConfig(depth=DepthConfig(model="stereo")),
    )
    document = {**load_config(path).model_dump(), "snippets": SnippetsConfig(memory_bytes=SNIPPET_BYTES)}
    path.write_text(commented_yaml(Config.model_validate(document)))
    return path


@pytest.mark.fault(
    "kill -9 at any moment under load, again and again", "nothing that was ever told to a client is lost"
)
@pytest.mark.parametrize(("kills", "seed"), [(2, 1), pytest.param(50, 2, marks=pytest.mark.slow)])
def test_killed_at_any_moment_nothing_reported_is_lost(
    tmp_path: Path,
    router: Router,
    config: Path,
    kills: int,
    seed: int,
    record_property: Callable[[str, object], None],
) -> None:
    with driving(rendered(EARLY_STEPPED), router):
        starts_s = lives(config, router, tmp_path / "state" / "windows", kills, seed)
    record_property(
        "figure",
        f"{kills} kills: first answer after {statistics.median(starts_s):.2f} s, at most {max(starts_s):.2f} s",
    )
