"""Windows, for a program that imports coec."""

from __future__ import annotations

from dataclasses import replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from coec.library.calibrating import calibrated
from coec.library.choices import Choices, Options
from coec.library.progress import Told
from coec.library.results import Result
from coec.reports.page.words import count
from coec.sources import windows
from coec.sources.windows import Loaded


class Window:
    """Pairs of a camera frame and a LiDAR sweep from one slice of a drive: the input of one calibration. Made by
    `Recording.window` and `Recording.windows`."""

    def __init__(self, source: str, frames: int | None, loaded: Loaded) -> None:
        self._source = source
        self._frames = frames
        self._loaded = loaded

    def __repr__(self) -> str:
        return f"<coec.Window {self.window_id}, {count(self.pairs, 'pair')}>"

    @property
    def window_id(self) -> str:
        """`<pair>-<stamp of the first camera frame, ns>`, or the recorded id."""
        return self._loaded.window.window_id

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self._loaded.window.pairs)

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return tuple(pair.stamp_ns for pair in self._loaded.window.pairs)

    @property
    def unpaired(self) -> dict[str, int]:
        """Number of frames that found no partner, by cause."""
        return dict(self._loaded.unpaired)

    @property
    def source(self) -> str:
        """The recording, as it was given to `coec.open`."""
        return self._source

    @property
    def frames(self) -> int | None:
        """The largest number of camera frames that was asked for; None: the usual number."""
        return self._frames

    @property
    def loaded(self) -> Loaded:
        """The window as the package itself passes it on. Not part of the stable interface."""
        return self._loaded

    @property
    def T_camera_lidar_start(self) -> NDArray[np.float64]:
        """(4, 4) pose at which a search starts, metres."""
        return self._loaded.window.T_camera_lidar_start.copy()

    def calibrate(self, **options: Unpack[Options]) -> Result:
        """Calibrates the window. The same window, network and configuration give the same result, to the byte.

        Args:
            options: as `coec.calibrate`.

        Raises:
            CoecError: as `coec.calibrate`.
        """
        perturb, configuration = options.get("perturb"), options.get("configuration")
        xi = None if perturb is None else windows.xi_of(f"perturb={perturb!r}", perturb)
        loaded = self._loaded if configuration is None else replace(self._loaded, configuration=configuration)
        done = calibrated(
            loaded,
            Choices.of(options),
            Told(options.get("progress")),
            perturbation=xi,
            camera_model=options.get("camera_model"),
            time_offset=options.get("time_offset", False),
        )
        return Result(done)
