"""`coec demo`: a simulated vehicle whose mount is displaced, and the service that detects and corrects it, with its
live view.

The vehicle renders and publishes, the service is a process of its own behind a Zenoh router, and a client observes. So
alarm and correction come from the service alone; only the client knows the truth.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from coec.calibration.types import Matrix4
from coec.config import Config
from coec.geometry import compilation_events
from coec.io import user_files as files
from coec.io.rig_files import mask_to_png
from coec.io.zenoh.query_client import connected, fetch_window
from coec.reports import console
from coec.reports.commented_yaml import commented_yaml
from coec.reports.formatting import count
from coec.schemas.keys import Keys
from coec_lab.demo import pair_client, pair_report
from coec_lab.demo.pair_client import NS_PER_S, Observer, Pace, PairOutcome, PairVehicle, Snapshot, outcome_of
from coec_lab.demo.service import QUERY_S, Daemon, DemoError, free_endpoint, running

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive

POLL_S = 0.2
"""Period of the live view, which queries the service as any user would."""

START_S, DRIVE_S = 600.0, 600.0
"""Time limits for the start of the service and for the drive. The first run on a machine compiles the kernels, in this
process and in the service: about a minute on two idle cores, several minutes on busy ones."""

BARS = "▁▂▃▄▅▆▇█"
BAR_WIDTH = 48
CURVE_WIDTH = 72

FIGURES = ("distance_rotation", "distance_pose", "edges_per_pair", "overlap", "mi")
"""Figures of the latest check of the monitor: those by which it decides, and mutual information."""


STARTING = "starting"
"""State of a worker that compiles its kernels, or reads them from the cache, before its first job."""


def run(output: Path, *, as_json: bool) -> int:
    """Runs the demonstration; returns 1 if there was no alarm, no correction, or the error is not within the limit.

    Raises:
        DemoError: the service does not start, answer or end.
        SourceError: the library that casts rays is not installed.
        OutputError: a file cannot be written.
    """
    files.try_folder(output)
    started_s = time.monotonic()
    config_of_drive = pair_client.drive_config()
    from coec_lab.simulation.drive import SimulatedDrive

    drive = SimulatedDrive(config_of_drive)
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        config = _configure(drive, folder)
        with running(folder / "coec.yaml", folder / "coec.log") as daemon, Screen() as screen:
            screen.show_text("The service starts, the street is built …")
            # Compiles kernels that the renderers then find compiled, while the service compiles its own.
            with compilation_events.listening(screen.on_compiling):
                picture, page = pair_report.write_first(output, drive)
            console.say(f"demo: the first picture is {picture}, and {page} shows it until there is a result")
            with connected(config.zenoh.connect, START_S) as session:
                observer = Observer(
                    session,
                    Keys(config.prefix, config.vehicle),
                    config.pairs[0].name,
                    drive.rig.T_camera_lidar_nominal,
                    _truth(drive),
                    drive.camera_stamps_ns[0],
                    Pace(drive.camera_stamps_ns[0]),
                    started_s,
                )
                _until_running(observer, daemon, screen)
                vehicle = PairVehicle(session, drive, observer.may_pass)
                snapshot, outcome = _observe(observer, vehicle, daemon, screen)
                screen.show_text("The window is fetched, the pictures are rendered …")
                window, accused = _fetch(observer, snapshot, output)
            daemon.end()
            left = pair_report.write(output, picture, window, accused, observer, snapshot, outcome)
    console.report(
        _document(observer, outcome, left, started_s),
        lambda: pair_report.show(observer.timeline, outcome, left),
        as_json=as_json,
    )
    return 0 if outcome.passed else 1


def _configure(drive: SimulatedDrive, folder: Path) -> Config:
    """Writes the configuration of the service, and the files that it names, into the folder."""
    rig = drive.rig
    mask = np.ones((rig.camera.height, rig.camera.width), bool) if rig.mask is None else rig.mask
    files.write_output(folder / "mask.png", mask_to_png(mask))
    config = pair_client.service_config(rig, Path("mask.png"), free_endpoint())
    files.write_output(folder / "coec.yaml", commented_yaml(config).encode())
    return config


def _truth(drive: SimulatedDrive) -> Callable[[float], Matrix4]:
    """Function that gives the true T_camera_lidar at a second of the drive."""
    first_ns = drive.camera_stamps_ns[0]
    return lambda second: drive.truth(first_ns + round(second * NS_PER_S))


def _until_running(observer: Observer, daemon: Daemon, screen: Screen) -> None:
    deadline_s = time.monotonic() + START_S
    while True:
        daemon.check()
        snapshot = observer.poll(0.0, 0)
        if snapshot is not None:
            screen.show(observer, snapshot)
            if snapshot.status.state == "running":
                return
        if time.monotonic() > deadline_s:
            raise DemoError(f"the service is not ready after {START_S:g} s", daemon.log_tail())
        time.sleep(POLL_S)


def _observe(observer: Observer, vehicle: PairVehicle, daemon: Daemon, screen: Screen) -> tuple[Snapshot, PairOutcome]:
    """Observes until the mount is corrected or the drive is over; returns the last snapshot, and the outcome."""
    deadline_s = time.monotonic() + DRIVE_S
    try:
        if vehicle.start(START_S):
            raise DemoError("the service does not subscribe to its sensors", daemon.log_tail())
        while True:
            daemon.check()
            arrived = vehicle.arrived
            if vehicle.failure is not None:
                raise vehicle.failure
            snapshot = observer.poll(vehicle.second, vehicle.pictures)
            if snapshot is None:
                raise DemoError("the service no longer answers", daemon.log_tail())
            screen.show(observer, snapshot)
            outcome = outcome_of(observer.timeline, pair_client.KNOCK_S, pair_client.MAX_ERROR_DEG)
            finished = outcome.repaired_s is not None and vehicle.second >= outcome.repaired_s + pair_client.REST_S
            if finished or arrived or time.monotonic() > deadline_s:
                return snapshot, outcome
            time.sleep(POLL_S)
    finally:
        vehicle.stop()


def _fetch(observer: Observer, snapshot: Snapshot, output: Path) -> tuple[Path | None, Matrix4]:
    """Fetches the window of the served extrinsic, if any; returns it, and what was served at the alarm."""
    events = observer.events()
    accused = np.array(events[-1].camera_from_lidar.matrix) if events else observer.nominal
    window_id = snapshot.extrinsic.window_id
    if window_id is None:
        return None, accused
    path = output / f"{window_id}.mcap"
    fetch_window(observer.session, observer.keys, observer.pair, window_id, path, QUERY_S, QUERY_S, lambda *_: None)
    return path, accused


def _document(
    observer: Observer, outcome: PairOutcome, left: pair_report.WrittenFiles, started_s: float
) -> dict[str, object]:
    last = observer.timeline[-1]
    return {
        "timeline": [asdict(moment) for moment in observer.timeline],
        "knock_s": outcome.knock_s,
        "knock_deg": pair_client.KNOCK_DEG,
        "alarm_s": outcome.alarm_s,
        "repaired_s": outcome.repaired_s,
        "error_before_deg": outcome.error_before_deg,
        "error_after_deg": outcome.error_after_deg,
        "error_by_axis_after_deg": last.error_by_axis_deg,
        "health": outcome.health,
        "passed": outcome.passed,
        "objections": outcome.failures(),
        "drive_s": last.drive_s,
        "elapsed_s": time.monotonic() - started_s,
        "files": [str(path) for path in left.files],
    }


class Screen:
    """Shows, while it is open, what the client sees."""

    def __init__(self) -> None:
        self._live = Live(console=console.err, transient=True, auto_refresh=False)
        self._last_line = ""
        self._news = console.CompilationProgress(time.monotonic)
        self._compiling_shown = False

    def __enter__(self) -> Screen:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._live.stop()

    def on_compiling(self, kernel: str) -> None:
        """Called by `compilation_events` when a kernel is being compiled in this process."""
        self._news.on_kernel(kernel)
        if self._news.lasted_s >= console.COMPILING_S:
            self._compiling(f"{console.COMPILING}: {self._news.kernels} so far, {self._news.lasted_s:.0f} s")

    def _compiling(self, text: str) -> None:
        if console.err.is_terminal:
            self.show_text(text)
        elif not self._compiling_shown:
            self._compiling_shown = True
            console.say(f"demo: {console.COMPILING}; the drive begins then")

    def show_text(self, what: str) -> None:
        """Shows a text while there is nothing to see yet."""
        if console.err.is_terminal:
            self._live.update(Panel(Text(what), title="coec demo", width=CURVE_WIDTH + 30), refresh=True)

    def show(self, observer: Observer, snapshot: Snapshot) -> None:
        """Shows the latest answers."""
        if console.err.is_terminal:
            self._live.update(view(observer, snapshot), refresh=True)
            return
        moment = snapshot.moment
        if snapshot.status.worker.state == STARTING and moment.t_s > console.COMPILING_S:
            self._compiling("")
            return
        line = f"{moment.health}, {moment.provenance}"
        if line != self._last_line:
            self._last_line = line
            console.say(f"demo: {moment.drive_s:5.1f} s of driving: {line}, {moment.error_deg:.2f}° from the truth")


def view(observer: Observer, snapshot: Snapshot) -> RenderableType:
    """The whole view of one instant."""
    moment, pair = snapshot.moment, snapshot.pair
    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="bold")
    rows.add_column()
    rows.add_row("drive", _drive(moment.drive_s) if snapshot.status.worker.state != STARTING else _before(moment.t_s))
    rows.add_row("health", Text.assemble(console.styled(moment.health), "  ", _reason(snapshot)))
    rows.add_row("error against the truth", _error(snapshot))
    rows.add_row("", curve(observer.series))
    rows.add_row("extrinsic", f"{moment.provenance}, {console.attempt(moment.status)}")
    rows.add_row("correction", "  ".join(f"{value:+.3f}°" for value in moment.correction_deg) + "  pitch, yaw, roll")
    rows.add_row("next window", _window(pair.selected))
    so_far = (count(pair.pairs, "pair"), count(pair.checks, "check"), count(pair.solved, "window"))
    rows.add_row("so far", f"{', '.join(so_far)} solved ({_worker(snapshot)})")
    return Panel(
        Group(rows, Text(), _figures(snapshot)), title=f"coec demo  {moment.t_s:.0f} s", width=CURVE_WIDTH + 30
    )


def curve(series: Sequence[tuple[float, float, str]], width: int = CURVE_WIDTH) -> Text:
    """The error over the drive as a row of bars, from 0 to a little more than the knock, in the colours of health."""
    latest: dict[int, tuple[float, str]] = {}
    seconds_per_bar = max(1.0, (series[-1][0] + 1.0) / width) if series else 1.0
    for second, error_deg, health in series:
        latest[int(second / seconds_per_bar)] = (error_deg, health)
    text = Text()
    for column in range(max(latest, default=-1) + 1):
        if column not in latest:
            text.append(" ")
            continue
        error_deg, health = latest[column]
        height = min(int(error_deg / (pair_client.KNOCK_DEG * 1.1) * len(BARS)), len(BARS) - 1)
        text.append(BARS[height], console.STATE_STYLES.get(health, "dim"))
    return text


def _before(t_s: float) -> Text:
    """Text while the drive waits for the worker to start."""
    return Text(f"waits: kernels compile, once, for about a minute; {t_s:.0f} s so far")


def _drive(second: float) -> Text:
    if second < pair_client.KNOCK_S:
        left_s = pair_client.KNOCK_S - second
        return Text(f"{second:5.1f} s   the mount is displaced by {pair_client.KNOCK_DEG:g}° in {left_s:.0f} s")
    ago = f"{second - pair_client.KNOCK_S:.0f} s ago"
    return Text.assemble(f"{second:5.1f} s   ", (f"DISPLACED by {pair_client.KNOCK_DEG:g}° {ago}", "bold magenta"))


def _error(snapshot: Snapshot) -> Text:
    style = "bold green" if snapshot.moment.error_deg < pair_client.MAX_ERROR_DEG else "bold red"
    return Text(f"{snapshot.moment.error_deg:.3f}°", style)


def _reason(snapshot: Snapshot) -> str:
    if snapshot.health.reasons:
        return snapshot.health.reasons[0].text
    figures = (snapshot.health.metrics.get(name) for name in FIGURES)
    if any(figure is not None and not figure.passed for figure in figures):
        return "The latest check contradicts it; one check alone decides nothing."
    return "The monitor reports no error."


def _worker(snapshot: Snapshot) -> str:
    return {"idle": "idle", "busy": "at work"}.get(snapshot.status.worker.state, snapshot.status.worker.state)


def _window(selected: int) -> RenderableType:
    grid = Table.grid(padding=(0, 2))
    bar = ProgressBar(total=pair_client.WINDOW.pairs, completed=selected, width=BAR_WIDTH)
    grid.add_row(bar, f"{selected} of {pair_client.WINDOW.pairs} pairs")
    return grid


def _figures(snapshot: Snapshot) -> Table:
    table = console.table("figure of the latest check", "value", "limit", "", right=(1,))
    for name in FIGURES:
        metric = snapshot.health.metrics.get(name)
        if metric is None:
            table.add_row(name, "-", "", "")
            continue
        table.add_row(name, console.figure(metric.value), *console.limit_of(metric))
    return table
