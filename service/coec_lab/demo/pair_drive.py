"""The drive of the demonstration with one camera: scenario, configuration of the service, and the vehicle that renders
ahead in other processes and publishes at the pace of the service."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import zenoh

from coec.calibration.types import Frame, Rig
from coec.config import (
    BudgetConfig,
    CameraConfig,
    Config,
    EgoConfig,
    LidarConfig,
    MonitorConfig,
    PairConfig,
    StateConfig,
    WindowConfig,
    WorkerConfig,
    ZenohConfig,
)
from coec.io.rig_files import intrinsics_config, matrix_rows
from coec.io.zenoh.player import CAMERA, Played, Player, StreamKeys
from coec.schemas import replies
from coec_lab.demo.service import MIN_FREE_BYTES, STORY_CORES
from coec_lab.simulation.source import require_embree

if TYPE_CHECKING:
    from coec_lab.simulation.drive import DriveConfig, SimulatedDrive

SEED = 1
LONGEST_S = 240.0
"""Longest drive; it ends as soon as the mount is corrected."""

WORKSHOP = (0.6, -0.5, 0.4, 0.0, 0.0, 0.0)
"""Error of the workshop's calibration: degrees in pitch, yaw, roll, and metres."""

KNOCK_S, KNOCK_DEG = 36.0, 3.0
"""When and by how much the mount is displaced, in pitch: after the first window has been judged."""

TITLE = f"A mount that is displaced by {KNOCK_DEG:g}° while the vehicle drives"
REPORT = "report.html"
"""File of the page, which exists from the first picture on."""

REST_S = 12.0
"""Driving after the correction: two more checks of the monitor."""

CLOSE_UP_PX = (170, 285, 400, 170)
"""Left, top, width and height of the part of the picture that shows cars and kerbs."""

PAIR_HZ, EGO_HZ = 1.0, 50.0
"""Frames per second of driving: only as many pairs are rendered as the service would select."""

WINDOW = WindowConfig(pairs=12, min_pairs=8, slice_s=24.0)
MONITOR = MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=12.0)
"""Shorter than on a vehicle, where a window takes three minutes, which is too long to watch."""

MAX_ERROR_DEG = 0.25
"""Largest error of a correction (geodesic angle)."""

RATE = 4.0
"""Most seconds of driving in a second; each half second, two pictures with their sweeps must be rendered."""

POLL_S = 0.05

RENDERERS = 2
"""Processes that render, each with its own street in memory."""

NS_PER_S = 1_000_000_000

LEAD_NS = 7 * NS_PER_S
"""The drive waits while it is so far ahead of what the service has judged: one check of the monitor, and a little."""

STEP_NS = 2 * NS_PER_S
"""A service that is idle although it has everything (no checks follow soon after a window) gets so much more."""

ON_THE_WAY = 1
"""Pictures that may still be in transit, or lost without a trace, when the service counts as having them all."""


def drive_config() -> DriveConfig:
    """A vehicle with a 185° fisheye of 700×700 pixels and a LiDAR of 64 beams, and the knock.

    Raises:
        SourceError: the library that casts rays is not installed.
    """
    require_embree()
    from coec_lab.simulation.drive import DriveConfig
    from coec_lab.simulation.faults import StepFault

    return DriveConfig(
        seed=SEED,
        seconds=LONGEST_S,
        camera="fisheye700",
        lidar="64",
        camera_hz=PAIR_HZ,
        lidar_hz=PAIR_HZ,
        ego_hz=EGO_HZ,
        faults=(StepFault(KNOCK_S, LONGEST_S, rx=KNOCK_DEG),),
        workshop=WORKSHOP,
    )


def service_config(rig: Rig, mask: Path, endpoint: str) -> Config:
    """Configuration of the service: defaults, except for rig, address, and what is shorter than on a vehicle."""
    streams = StreamKeys.default(rig.pair)
    pair = PairConfig(
        name=rig.pair,
        camera=CameraConfig(
            key=streams.camera,
            frame_id=rig.camera_frame,
            intrinsics=intrinsics_config(rig.camera),
            mask=mask,
        ),
        lidar=LidarConfig(key=streams.lidar, frame_id=rig.lidar_frame),
        ego=EgoConfig(key=str(streams.ego), T_lidar_ego=matrix_rows(rig.T_lidar_ego)),
        T_camera_lidar=matrix_rows(rig.T_camera_lidar_nominal),
        window=WINDOW,
        monitor=MONITOR,
    )
    return Config(
        budget=BudgetConfig(cores=STORY_CORES),
        zenoh=ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=MIN_FREE_BYTES),
        # The solver competes with rendering here; on a vehicle cameras take no processor time.
        worker=WorkerConfig(niceness=0),
        pairs=(pair,),
    )


@dataclass(slots=True)
class Pace:
    """How far the drive may go.

    Attributes:
        judged_ns: sensor time up to which the service has judged, or has nothing left to judge.
    """

    judged_ns: int

    def update(self, judged_ns: int | None, *, at_rest: bool, stamp_ns: int) -> None:
        """Takes a report of the service into account.

        Args:
            judged_ns: sensor time up to which it has judged; None: nothing yet.
            at_rest: whether it is idle although it has everything that was sent.
            stamp_ns: sensor time up to which the drive had been sent when the service was queried.
        """
        self.judged_ns = max(self.judged_ns, judged_ns or 0)
        if at_rest:
            self.judged_ns = max(self.judged_ns, stamp_ns + STEP_NS - LEAD_NS)

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return stamp_ns <= self.judged_ns + LEAD_NS


def at_rest(worker: replies.WorkerStatus, pair: replies.PairStatus, sent: int) -> bool:
    """Whether the service has received `sent` pictures and is idle.

    Its report of worker and pairs is of one instant, and is renewed every second.
    """
    arrived = pair.camera.received + sum(pair.camera.losses.values())
    idle = worker.state == "idle" and not worker.queued and not pair.held and not pair.unanswered
    return idle and arrived + ON_THE_WAY >= sent


class PairVehicle:
    """Drives in a thread of its own.

    Attributes:
        stamp_ns: sensor time of the latest published frame; before that, of the first picture.
        played: how many frames of each stream were published.
        failure: why the thread ended early; None if it did not.
    """

    def __init__(self, session: zenoh.Session, drive: SimulatedDrive, may_pass: Callable[[int], bool]) -> None:
        """`may_pass`: whether the drive may go on to a sensor time."""
        self._drive = drive
        self._may_pass = may_pass
        self._player = Player(session, StreamKeys.default(drive.rig.pair), "msgpack")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle")
        self.stamp_ns = drive.camera_stamps_ns[0]
        self.played: Played = self._player.played
        self.failure: Exception | None = None

    @property
    def arrived(self) -> bool:
        """Whether the drive is over."""
        return not self._thread.is_alive()

    @property
    def second(self) -> float:
        """The present second of the drive."""
        return max((self.stamp_ns - self._drive.camera_stamps_ns[0]) / NS_PER_S, 0.0)

    @property
    def pictures(self) -> int:
        """How many pictures have been sent."""
        return self.played.frames[CAMERA]

    def start(self, wait_s: float) -> list[str]:
        """Starts the drive once the service subscribes; returns the keys without a subscriber after `wait_s`."""
        without_listener = self._player.wait_for_listener(wait_s)
        if not without_listener:
            self._thread.start()
        return without_listener

    def stop(self) -> None:
        """Ends the drive."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._player.close()

    def _run(self) -> None:
        from coec_lab.simulation.parallel import messages_by

        try:
            frames = messages_by(self._drive.config, min(os.cpu_count() or 1, RENDERERS))
            self._player.play(paced(frames, self._may_pass, self._stop), 0.0, self._stop, self._on_sent)
        except Exception as error:  # reported by the thread that watches
            self.failure = error

    def _on_sent(self, frame: Frame, _: Played) -> None:
        self.stamp_ns = frame.stamp_ns


def paced(
    frames: Iterable[Frame], may_pass: Callable[[int], bool], stop: threading.Event, rate: float = RATE
) -> Iterator[Frame]:
    """Yields each frame when it is due after the one before and the service has kept up.

    Args:
        may_pass: whether the drive may go on to a sensor time.
        stop: ends all waiting.
        rate: most seconds of driving in a second.
    """
    before_ns, before_s = None, 0.0
    for frame in frames:
        if before_ns is not None:
            stop.wait(max(before_s + (frame.stamp_ns - before_ns) / NS_PER_S / rate - time.monotonic(), 0.0))
        while not may_pass(frame.stamp_ns) and not stop.wait(POLL_S):
            pass
        before_ns, before_s = frame.stamp_ns, time.monotonic()
        yield frame
