"""Recordings, for a program that imports coec."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from os import PathLike, fspath
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from coec.config import CalibrationConfig, WindowConfig
from coec.errors import UsageError
from coec.evaluation.fitness import Cadence, cadence
from coec.geometry.cameras import intrinsics_of, name_of
from coec.library.choices import Options
from coec.library.progress import Progress, Told
from coec.library.results import Result
from coec.library.windows import Window
from coec.reports.page.words import count
from coec.sources import Recording as Opened
from coec.sources import open_source, windows
from coec.sources.recording import KnowsTruth
from coec.sources.windows import NoPairsError
from coec.untrusted import Untrusted, printable

NS_PER_S = 1e9


def open(source: str | PathLike[str]) -> Recording:
    """Opens a recorded drive of one camera-LiDAR pair. Frames are loaded later, when a window is cut.

    Args:
        source: what `coec calibrate SOURCE` takes: a recorded window or ROS 2 bag (`drive.mcap`), a folder or its
            `dataset.yaml`, `kitti360:ROOT?camera=image_00`, `kitti-raw:ROOT?...`, `sim:seed=1&seconds=60`.

    Raises:
        UsageError: `source` does not fit the grammar, or its query has an unknown key; the message lists those known.
        SourceError: the recording is absent, incomplete or not in the layout that its name promises.
        WindowError: a recorded window that is damaged.

    Example:
        >>> import coec
        >>> drive = coec.open("sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes")
        >>> print(drive.describe())
        simulated drive, seed 1: 10.0 s of the pair sim
          camera  6 frames, 0.50 Hz  double_sphere, 160 x 160 px, frame camera
          LiDAR   6 sweeps, 0.50 Hz  frame lidar
          motion  600 samples, 50.00 Hz
    """
    text = fspath(source)
    return Recording(text, open_source(text))


@dataclass(frozen=True, slots=True)
class Description:
    """What a recording holds, as far as it is known without loading its frames. `str()` makes lines to print of it.

    Attributes:
        name: layout, drive, camera.
        pair: name of the camera-LiDAR pair.
        seconds: from the first camera frame to the last.
        camera, lidar, motion: number of frames, rate (Hz, of the median interval) and longest gap (s) of each stream.
            `motion` is None where the recording has no ego-motion; its sweeps are then not compensated.
        camera_model: one of `pinhole, radtan, rational, kannala_brandt, mei, eucm, double_sphere`.
        intrinsics: its parameters by name, with `width` and `height`; pixels where they have a unit.
        camera_frame, lidar_frame: names of the coordinate frames.
    """

    name: str
    pair: str
    seconds: float
    camera: Cadence
    lidar: Cadence
    motion: Cadence | None
    camera_model: str
    intrinsics: dict[str, float]
    camera_frame: str
    lidar_frame: str

    def __str__(self) -> str:
        width, height = self.intrinsics["width"], self.intrinsics["height"]
        motion = (
            "none" if self.motion is None else f"{count(self.motion.frames, 'sample')}, {self.motion.rate_hz:.2f} Hz"
        )
        # Names and frames are as the recording has them, and whoever prints this has a terminal that would obey them.
        return "\n".join(
            printable(line, None)
            for line in (
                f"{self.name}: {self.seconds:.1f} s of the pair {self.pair}",
                f"  camera  {count(self.camera.frames, 'frame')}, {self.camera.rate_hz:.2f} Hz  {self.camera_model}, "
                f"{width:.0f} x {height:.0f} px, frame {self.camera_frame}",
                f"  LiDAR   {count(self.lidar.frames, 'sweep')}, {self.lidar.rate_hz:.2f} Hz  frame {self.lidar_frame}",
                f"  motion  {motion}",
            )
        )


class Recording:
    """A recorded drive of one camera-LiDAR pair, made by `coec.open`."""

    def __init__(self, source: str, opened: Opened) -> None:
        self._source = source
        self._opened = opened

    def __repr__(self) -> str:
        return f"<coec.Recording {Untrusted(self._opened.name)}>"

    @property
    def source(self) -> str:
        """The recording, as it was given to `coec.open`."""
        return self._source

    @property
    def name(self) -> str:
        """Layout, drive and camera, for people to read."""
        return self._opened.name

    @property
    def T_camera_lidar(self) -> NDArray[np.float64]:
        """(4, 4) the calibration that came with the recording, metres: maps LiDAR coordinates (x forward, y left, z up)
        to camera coordinates (x right, y down, z forward). A `correction` is relative to it."""
        return self._opened.rig.T_camera_lidar_nominal.copy()

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return self._opened.camera_stamps_ns

    @property
    def seconds(self) -> float:
        """From the first camera frame to the last."""
        stamps_ns = self.camera_stamps_ns
        return (stamps_ns[-1] - stamps_ns[0]) / NS_PER_S if stamps_ns else 0.0

    @property
    def configuration(self) -> CalibrationConfig | None:
        """Configuration that a recorded window carries; None for every other recording."""
        return self._opened.configuration

    def describe(self) -> Description:
        """Streams, rates, camera and frames. Print it."""
        opened, rig = self._opened, self._opened.rig
        return Description(
            name=opened.name,
            pair=rig.pair,
            seconds=self.seconds,
            camera=cadence(opened.camera_stamps_ns),
            lidar=cadence(opened.sweep_stamps_ns),
            motion=cadence(opened.motion_stamps_ns) if opened.motion_stamps_ns else None,
            camera_model=name_of(rig.camera),
            intrinsics=dict(intrinsics_of(rig.camera)),
            camera_frame=rig.camera_frame,
            lidar_frame=rig.lidar_frame,
        )

    def truth(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """(4, 4) true T_camera_lidar at a time, if the drive was simulated; else None."""
        return self._opened.truth(stamp_ns) if isinstance(self._opened, KnowsTruth) else None

    def window(
        self,
        *,
        frames: int | None = None,
        between_s: tuple[float, float] | None = None,
        progress: Progress | None = None,
    ) -> Window:
        """Cuts one window: evenly chosen camera frames, each with the sweep nearest to it in time.

        Args:
            frames: how many camera frames at most; None: 25, or all that a recorded window has.
            between_s: (begin, end), seconds after the first frame of the recording; only frames between them are used,
                both ends included. None: the whole recording.
            progress: is called for the stage `load`.

        Raises:
            UsageError: `frames` is below 1, or `between_s` is no interval.
            SourceError: a file cannot be read, or no camera frame has a sweep near enough.
            WindowError: a recorded window is damaged.
        """
        if frames is not None and frames < 1:
            raise UsageError(f"frames={frames}: a window has at least one")
        begin_s, end_s = windows.WHOLE if between_s is None else between_s
        if not 0.0 <= begin_s <= end_s:
            raise UsageError(f"between_s=({begin_s:g}, {end_s:g}): give seconds after the first frame, begin and end")
        told = Told(progress)

        def heard(done: int, total: int) -> None:
            told.step("load", done, total)

        usual = WindowConfig().pairs
        if self.configuration is None:
            loaded = windows.chosen_from(self._opened, frames or usual, heard, (begin_s, end_s))
        else:  # a recorded window keeps its pairs
            loaded = windows.load(self._source, frames, usual, heard, (begin_s, end_s))
        return Window(self._source, frames, loaded)

    def windows(self, *, seconds: float = 60.0, frames: int | None = None) -> Iterator[Window]:
        """Cuts the recording into consecutive windows of `seconds` each. The last one takes the rest, which is half to
        one and a half times as long. A window is loaded when the loop comes to it. A slice in which no camera frame has
        a sweep is left out.

        Raises:
            UsageError: `seconds` is not above 0, or `frames` is below 1.
            SourceError, WindowError: as `window`.
        """
        if not 0.0 < seconds < inf:
            raise UsageError(f"seconds={seconds:g}: give a finite length above 0")
        count = max(1, round(self.seconds / seconds))
        for index in range(count):
            # `window` includes both ends; a frame on the border belongs to the window that begins there.
            end_s = inf if index == count - 1 else float(np.nextafter((index + 1) * seconds, 0.0))
            with suppress(NoPairsError):
                yield self.window(frames=frames, between_s=(index * seconds, end_s))

    def calibrate(self, *, frames: int | None = None, **options: Unpack[Options]) -> Result:
        """Calibrates the recording's window of at most `frames` camera frames (None: 25).

        Args:
            frames: as `window`.
            options: as `coec.calibrate`.

        Raises:
            CoecError: as `window` and `coec.calibrate`.
        """
        return self.window(frames=frames, progress=options.get("progress")).calibrate(**options)
