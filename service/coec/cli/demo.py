"""`coec demo`: the whole service on a drive that needs no data, from frames on the bus to an accepted extrinsic."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from rich.live import Live

import coec
from coec.adapters.mcap_windows import read_result, read_window
from coec.adapters.player import Player, Streams
from coec.adapters.rig import mask_to_png
from coec.adapters.zenoh_client import RemoteError, ask, ask_one, connected
from coec.calibration.values import Matrix4
from coec.cli import console, files, pictures, windows
from coec.cli.commented_yaml import commented_yaml
from coec.cli.convert import configuration_for
from coec.cli.query import download_window
from coec.config import Config, ObjectiveConfig, StateConfig, ZenohConfig
from coec.errors import CoecError, NotFoundError
from coec.geometry import se3
from coec.schemas import replies
from coec.schemas.base import from_json, to_json
from coec.schemas.keys import Keys
from coec.sources import Recording, open_source

SOURCE = "synthetic:"

PERTURBATION_DEG = (2.0, -1.5, 1.0)
"""About the camera's axes: how wrong the workshop calibration of the demonstration is."""

MAX_ERROR_DEG = 0.35
"""What the result must be within of the truth, as on real recordings (geodesic angle)."""

RATE = 60.0
"""Three minutes of driving in three seconds."""

POLL_S = 0.2
START_S, SOLVE_S, STOP_S, ASK_S = 60.0, 90.0, 15.0, 5.0
"""Limits for the service to come up, to solve, to end, and to answer. The first run compiles the kernels."""

MIN_FREE_BYTES = 64 * 2**20
"""The drive makes one window of 7 MB; a demonstration need not leave more of the disk free."""


class DemoError(CoecError):
    """The service of the demonstration did not do its part."""

    reply_code = "demo_failed"


@dataclass(frozen=True, slots=True)
class Moment:
    """What the service said at one instant. Angles in degrees, error against the truth."""

    t_s: float
    service: str
    health: str
    provenance: str
    status: str
    pairs_chosen: int
    windows: int
    correction_deg: tuple[float, float, float]
    error_deg: float


@dataclass(slots=True)
class Watch:
    """Asks the service again and again, keeps what changed, shows the latest."""

    session: zenoh.Session
    keys: Keys
    pair: str
    truth: Matrix4
    nominal: Matrix4
    started_s: float
    timeline: list[Moment] = field(default_factory=list)
    received: Counter[str] = field(default_factory=Counter)
    T_camera_lidar: Matrix4 = field(default_factory=lambda: np.eye(4))

    def look(self) -> Moment:
        """The state now.

        Raises:
            NotFoundError, RemoteError: the service does not answer.
        """
        status = from_json(replies.StatusReply, self._ask(self.keys.status))
        health = from_json(replies.HealthReply, self._ask(self.keys.health(self.pair)))
        extrinsic = from_json(replies.ExtrinsicReply, self._ask(self.keys.extrinsic(self.pair)))
        (pair,) = status.pairs
        self.received = Counter(camera=pair.camera.received, lidar=pair.lidar.received)
        self.T_camera_lidar = np.array(extrinsic.camera_from_lidar.matrix)
        moved_deg = np.degrees(se3.difference(self.T_camera_lidar, self.nominal)[:3])
        moment = Moment(
            t_s=time.monotonic() - self.started_s,
            service=status.state,
            health=health.state,
            provenance=extrinsic.provenance,
            status=extrinsic.status,
            pairs_chosen=pair.selected,
            windows=pair.windows,
            correction_deg=(float(moved_deg[0]), float(moved_deg[1]), float(moved_deg[2])),
            error_deg=windows.rotation_error_deg(self.T_camera_lidar, self.truth),
        )
        if not self.timeline or _essence(moment) != _essence(self.timeline[-1]):
            self.timeline.append(moment)
        return moment

    def _ask(self, key: str) -> bytes:
        return ask_one(self.session, f"{key}?format=json", ASK_S).payload


def run(output: Path, *, as_json: bool) -> int:
    """Runs the demonstration; 1 if the result is not within `MAX_ERROR_DEG` of the truth and healthy.

    Raises:
        DemoError: the service does not start, answer or solve.
    """
    started_s = time.monotonic()
    recording = open_source(SOURCE)
    truth = recording.rig.T_camera_lidar_nominal
    nominal = se3.perturb(truth, np.array([*np.radians(PERTURBATION_DEG), 0.0, 0.0, 0.0]))
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        config = _configuration(recording, nominal, folder)
        with _service(folder / "coec.yaml", folder / "coec.log") as child:
            with connected(config.zenoh.connect, START_S) as session:
                watch = Watch(
                    session, Keys(config.prefix, config.vehicle), config.pairs[0].name, truth, nominal, started_s
                )
                with Live(console=console.err, transient=True, auto_refresh=False) as live:
                    window_id = _drive(watch, recording, child, folder / "coec.log", live)
                window = output / f"{window_id}.mcap"
                download_window(session, watch.keys, watch.pair, window_id, window, ASK_S, lambda *_: None)
            _end(child)
    written = [window, *_write(output, window, watch)]
    return _report(watch, written, as_json)


def _configuration(recording: Recording, nominal: Matrix4, folder: Path) -> Config:
    """Writes `coec.yaml` into the folder: everything default, but for what the recording and a free port dictate."""
    mask = recording.rig.mask
    if mask is not None:
        files.write(folder / "mask.png", mask_to_png(mask))
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    pair = configuration_for(recording, nominal, None if mask is None else Path("mask.png"))
    # The drive comes with exact depth, and its pictures have 0.4° to a pixel: the paper's objective is sharper here.
    paper = pair.calibration.model_copy(update={"objective": ObjectiveConfig(kind="mi")})
    pair = pair.model_copy(update={"calibration": paper})
    config = Config(
        zenoh=ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=MIN_FREE_BYTES),
        pairs=(pair,),
    )
    files.write(folder / "coec.yaml", commented_yaml(config).encode())
    return config


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def _service(config: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`coec run` as a process of its own, as on a vehicle."""
    command = [sys.executable, "-m", "coec", "run", "--config", str(config), "--embedded-router"]
    # The package is found where this one was, also when it is not installed.
    path = os.pathsep.join(filter(None, [str(Path(coec.__file__).parent.parent), os.environ.get("PYTHONPATH")]))
    with log.open("wb") as stream:
        child = subprocess.Popen(command, stdout=stream, stderr=stream, env={**os.environ, "PYTHONPATH": path})
    try:
        yield child
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def _drive(watch: Watch, recording: Recording, child: subprocess.Popen[bytes], log: Path, live: Live) -> str:
    """Plays the recording, has the window finished, waits for the decision; the window's id."""
    _until(watch, child, log, live, START_S, "the service answers", lambda _: True)
    player = Player(watch.session, Streams.default(watch.pair), "msgpack")
    if player.wait_for_listener(START_S):
        raise DemoError("the service does not listen to its sensors")
    stop, failures = threading.Event(), []

    def play() -> None:
        try:
            player.play(recording.messages(), RATE, stop, lambda *_: None)
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=play, name="player")
    thread.start()
    try:
        done = Counter(camera=len(recording.camera_stamps_ns), lidar=len(recording.camera_stamps_ns))
        what = "every frame has arrived"
        _until(watch, child, log, live, START_S, what, lambda _: bool(failures) or watch.received >= done)
    finally:
        stop.set()
        thread.join()
        player.close()
    if failures:
        raise failures[0]
    selector = f"{watch.keys.command(watch.pair, 'calibrate')}?format=json"
    reply = from_json(replies.Acknowledgement, ask_one(watch.session, selector, ASK_S).payload)
    if not reply.accepted or reply.window_id is None:
        raise DemoError(f"the service does not calibrate: {reply.text}")
    _until(watch, child, log, live, SOLVE_S, "the window is solved", _is_solved)
    return reply.window_id


def _until(
    watch: Watch,
    child: subprocess.Popen[bytes],
    log: Path,
    live: Live,
    limit_s: float,
    what: str,
    condition: Callable[[Moment], bool],
) -> None:
    deadline_s = time.monotonic() + limit_s
    while True:
        if child.poll() is not None:
            raise DemoError(f"the service ended with status {child.returncode}; its last words:\n{_tail(log)}")
        moment = _look(watch)
        if moment is not None:
            live.update(_panel(watch, moment), refresh=True)
            if condition(moment):
                return
        if time.monotonic() > deadline_s:
            raise DemoError(f"waited {limit_s:g} s in vain until {what}; the last words of the service:\n{_tail(log)}")
        time.sleep(POLL_S)


def _is_solved(moment: Moment) -> bool:
    """Its parts were asked for one after the other: all of them must tell of the decision."""
    return moment.windows > 0 and moment.status != "not_accepted" and moment.health != "unknown"


def _look(watch: Watch) -> Moment | None:
    """The state, or None while the service is not there yet."""
    if not ask(watch.session, watch.keys.status, ASK_S):
        return None
    try:
        return watch.look()
    except (NotFoundError, RemoteError):
        return None


def _end(child: subprocess.Popen[bytes]) -> None:
    child.send_signal(signal.SIGTERM)
    try:
        status = child.wait(STOP_S)
    except subprocess.TimeoutExpired as error:
        raise DemoError(f"the service did not end within {STOP_S:g} s") from error
    if status != 0:
        raise DemoError(f"the service ended with status {status}")


def _write(output: Path, path: Path, watch: Watch) -> list[Path]:
    """Pictures and result beside the window."""
    window, configuration = read_window(path)
    result = read_result(path)
    if result is None:
        raise DemoError(f"{path} holds no result")
    before_deg = windows.rotation_error_deg(watch.nominal, watch.truth)
    after_deg = windows.rotation_error_deg(watch.T_camera_lidar, watch.truth)
    poses = {
        "overlay_before": (watch.nominal, f"{watch.pair}  workshop calibration, {before_deg:.2f} deg from the truth"),
        "overlay_after": (watch.T_camera_lidar, f"{watch.pair}  {result.status}, {after_deg:.2f} deg from the truth"),
    }
    written = pictures.write_overlays(output, window, poses, configuration.motion_compensation)
    return [*written, files.write(output / "result.json", to_json(result))]


def _report(watch: Watch, written: list[Path], as_json: bool) -> int:
    first, last = watch.timeline[0], watch.timeline[-1]
    before = np.degrees(se3.difference(watch.nominal, watch.truth)[:3])
    after = np.degrees(se3.difference(watch.T_camera_lidar, watch.truth)[:3])
    good = last.error_deg < MAX_ERROR_DEG and last.health == "healthy"
    if as_json:
        console.print_json(
            {
                "timeline": [asdict(moment) for moment in watch.timeline],
                "error_before_deg": first.error_deg,
                "error_after_deg": last.error_deg,
                "error_by_axis_before_deg": before.tolist(),
                "error_by_axis_after_deg": after.tolist(),
                "health": last.health,
                "passed": good,
                "elapsed_s": time.monotonic() - watch.started_s,
                "files": [str(path) for path in written],
            }
        )
        return 0 if good else 1
    steps = console.table("s", "service", "extrinsic", "health", "pairs", "windows", "error", right=(0, 4, 5, 6))
    for moment in watch.timeline:
        served = f"{moment.provenance}, {moment.status}"
        counts = (str(moment.pairs_chosen), str(moment.windows), f"{moment.error_deg:.3f}°")
        steps.add_row(f"{moment.t_s:.1f}", moment.service, served, console.styled(moment.health), *counts)
    console.out.print(steps)
    errors = console.table("error against the truth", "before", "after", right=(1, 2))
    for axis in range(3):
        errors.add_row(console.AXIS_NAMES[axis], f"{before[axis]:+.3f}°", f"{after[axis]:+.3f}°")
    errors.add_row("in all", f"{first.error_deg:.3f}°", f"{last.error_deg:.3f}°")
    console.out.print()
    console.out.print(errors)
    console.out.print()
    for path in written:
        console.show(f"{path}  {path.stat().st_size} bytes")
    limit = f"less than {MAX_ERROR_DEG}° and healthy"
    console.out.print(console.styled("accepted" if good else "failed"), f": {limit} was asked for", sep="")
    return 0 if good else 1


def _panel(watch: Watch, moment: Moment) -> Any:
    table = console.table("", "")
    table.add_row("service", moment.service)
    table.add_row("frames", ", ".join(f"{count} {stream}" for stream, count in sorted(watch.received.items())))
    table.add_row("pairs in the window", str(moment.pairs_chosen))
    table.add_row("extrinsic", f"{moment.provenance}, {moment.status}")
    table.add_row("health", console.styled(moment.health))
    table.add_row("correction", "  ".join(f"{value:+.3f}°" for value in moment.correction_deg))
    table.add_row("error against the truth", f"{moment.error_deg:.3f}°")
    return table


def _essence(moment: Moment) -> tuple[object, ...]:
    """What must change to make a new line of the timeline."""
    return moment.service, moment.health, moment.provenance, moment.status, moment.pairs_chosen, moment.windows


def _tail(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines()[-5:]
    return "\n".join(_plain(line) for line in lines)


def _plain(line: str) -> str:
    """The message of a JSON log line; any other line as it is."""
    try:
        record = json.loads(line)
    except ValueError:
        return line
    return f"{record.get('level')}: {record.get('message')}" if isinstance(record, dict) else line
