"""`coec demo`: a simulated vehicle whose mount is knocked, and the service that notices and repairs it.

The vehicle renders and publishes, the service is a process of its own behind a Zenoh router, and a client watches. So
alarm and repair come from the service alone; only the client knows the truth.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coec.adapters.files import output as files
from coec.adapters.files.rig import mask_to_png
from coec.adapters.zenoh.client import connected
from coec.adapters.zenoh.window_fetch import fetch_window
from coec.calibration.types import Matrix4
from coec.config import Config
from coec.geometry import compile_news
from coec.reports import console
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from coec_lab.demo import first_look, report, story
from coec_lab.demo.daemon import Daemon, DemoError, free_endpoint, running
from coec_lab.demo.outcome import Ending, outcome_of
from coec_lab.demo.pace import Pace
from coec_lab.demo.screen import Screen
from coec_lab.demo.vehicle import NS_PER_S, Vehicle
from coec_lab.demo.watch import ASK_S, Seen, Watch

if TYPE_CHECKING:
    from coec.simulation.drive import SimulatedDrive

POLL_S = 0.2
"""Period of the live view, which asks the service by query, as any user would."""

START_S, DRIVE_S = 600.0, 600.0
"""Time limits for the start of the service and for the drive. The first run on a machine compiles the kernels, in this
process and in the service: about a minute on two idle cores, several minutes on busy ones."""


def run(output: Path, *, as_json: bool) -> int:
    """Runs the demonstration; returns 1 if the story did not come true: no alarm, no repair, or not within the limit.

    Raises:
        DemoError: the service does not start, answer or end.
        SourceError: the library that casts rays is not installed.
        OutputError: a file cannot be written.
    """
    files.try_folder(output)
    started_s = time.monotonic()
    config_of_drive = story.drive_config()
    from coec.simulation.drive import SimulatedDrive

    drive = SimulatedDrive(config_of_drive)
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        config = _configure(drive, folder)
        with running(folder / "coec.yaml", folder / "coec.log") as daemon, Screen() as screen:
            screen.wait("The service starts, the street is built …")
            # Compiles kernels that the renderers then find compiled, while the service compiles its own.
            with compile_news.heard_by(screen.hear):
                picture, page = first_look.write(output, drive)
            console.say(f"demo: the first picture is {picture}, and {page} shows it until there is more to tell")
            with connected(config.zenoh.connect, START_S) as session:
                watch = Watch(
                    session,
                    Keys(config.prefix, config.vehicle),
                    config.pairs[0].name,
                    drive.rig.T_camera_lidar_nominal,
                    _truth(drive),
                    drive.camera_stamps_ns[0],
                    Pace(drive.camera_stamps_ns[0]),
                    started_s,
                )
                _until_running(watch, daemon, screen)
                vehicle = Vehicle(session, drive, watch.may_pass)
                seen, outcome = _watch(watch, vehicle, daemon, screen)
                screen.wait("The window is fetched, the pictures are drawn …")
                window, blamed = _fetch(watch, seen, output)
            daemon.end()
            left = report.write(output, picture, window, blamed, watch, seen, outcome)
    if as_json:
        console.print_json(_document(watch, outcome, left, started_s))
    else:
        report.show(watch.timeline, outcome, left)
    return 0 if outcome.passed else 1


def _configure(drive: SimulatedDrive, folder: Path) -> Config:
    """Writes the configuration of the service, and the files that it names, into the folder."""
    rig = drive.rig
    mask = np.ones((rig.camera.height, rig.camera.width), bool) if rig.mask is None else rig.mask
    files.write(folder / "mask.png", mask_to_png(mask))
    config = story.service_config(rig, Path("mask.png"), free_endpoint())
    files.write(folder / "coec.yaml", commented_yaml(config).encode())
    return config


def _truth(drive: SimulatedDrive) -> Callable[[float], Matrix4]:
    """Function that gives the true T_camera_lidar at a second of the drive."""
    first_ns = drive.camera_stamps_ns[0]
    return lambda second: drive.truth(first_ns + round(second * NS_PER_S))


def _until_running(watch: Watch, daemon: Daemon, screen: Screen) -> None:
    deadline_s = time.monotonic() + START_S
    while True:
        daemon.check()
        seen = watch.look(0.0, 0)
        if seen is not None:
            screen.show(watch, seen)
            if seen.status.state == "running":
                return
        if time.monotonic() > deadline_s:
            raise DemoError(f"the service is not ready after {START_S:g} s", daemon.last_words())
        time.sleep(POLL_S)


def _watch(watch: Watch, vehicle: Vehicle, daemon: Daemon, screen: Screen) -> tuple[Seen, Ending]:
    """Watches until the story is told or the drive is over; returns what was seen last, and the outcome."""
    deadline_s = time.monotonic() + DRIVE_S
    try:
        if vehicle.start(START_S):
            raise DemoError("the service does not listen to its sensors", daemon.last_words())
        while True:
            daemon.check()
            arrived = vehicle.arrived
            if vehicle.failure is not None:
                raise vehicle.failure
            seen = watch.look(vehicle.second, vehicle.pictures)
            if seen is None:
                raise DemoError("the service answers no more", daemon.last_words())
            screen.show(watch, seen)
            outcome = outcome_of(watch.timeline, story.KNOCK_S, story.MAX_ERROR_DEG)
            told = outcome.repaired_s is not None and vehicle.second >= outcome.repaired_s + story.REST_S
            if told or arrived or time.monotonic() > deadline_s:
                return seen, outcome
            time.sleep(POLL_S)
    finally:
        vehicle.stop()


def _fetch(watch: Watch, seen: Seen, output: Path) -> tuple[Path | None, Matrix4]:
    """Fetches the window of the served extrinsic, if any; returns it, and what was served at the alarm."""
    events = watch.events()
    blamed = np.array(events[-1].camera_from_lidar.matrix) if events else watch.nominal
    window_id = seen.extrinsic.window_id
    if window_id is None:
        return None, blamed
    path = output / f"{window_id}.mcap"
    fetch_window(watch.session, watch.keys, watch.pair, window_id, path, ASK_S, ASK_S, lambda *_: None)
    return path, blamed


def _document(watch: Watch, outcome: Ending, left: report.Left, started_s: float) -> dict[str, object]:
    last = watch.timeline[-1]
    return {
        "timeline": [asdict(moment) for moment in watch.timeline],
        "knock_s": outcome.knock_s,
        "knock_deg": story.KNOCK_DEG,
        "alarm_s": outcome.alarm_s,
        "repaired_s": outcome.repaired_s,
        "error_before_deg": outcome.error_before_deg,
        "error_after_deg": outcome.error_after_deg,
        "error_by_axis_after_deg": last.error_by_axis_deg,
        "health": outcome.health,
        "passed": outcome.passed,
        "objections": outcome.objections(),
        "drive_s": last.drive_s,
        "elapsed_s": time.monotonic() - started_s,
        "files": [str(path) for path in left.files],
    }
