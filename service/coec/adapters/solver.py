"""The work of the worker: depth of an image, calibration of a window file. No process, no socket."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coec.adapters.depth import CachedDepth, open_depth
from coec.adapters.images import GreyImages
from coec.adapters.mcap_windows import read_window, write_result
from coec.adapters.msgpack_frames import decode_camera
from coec.adapters.rig import rig_of
from coec.adapters.wire import result_of
from coec.calibration.calibrator import calibrate
from coec.calibration.ports import Silence
from coec.calibration.values import (
    CameraFrame,
    DepthMap,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Reason,
    Rig,
    Window,
)
from coec.config import Config, DepthConfig
from coec.errors import CalibrationError, CoecError, DecodeError, RecordingError, WindowError
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)

WARM_UP_POINTS = 4000
WARM_UP_DEPTH_PX = (48, 64)


@dataclass(frozen=True, slots=True)
class Solution:
    """The result of a window; `note` says why the window file does not hold it, if it does not."""

    result: CalibrationResult
    note: Reason | None


class Solver:
    """Opens the networks of the configuration once and keeps the depth of recent images."""

    def __init__(self, config: Config, depth_maps_kept: int) -> None:
        """Open every depth model that a pair of `config` names.

        Raises:
            ModelError: a network is missing, corrupt or does not match its card.
            ConfigError: a rig cannot be built.
        """
        self._config = config
        self._depth_maps_kept = depth_maps_kept
        self._images = GreyImages(config.limits)
        self._networks: dict[DepthConfig, CachedDepth] = {}
        self._depth_of_pair = {pair.name: pair.calibration.depth for pair in config.pairs}
        for depth in self._depth_of_pair.values():
            self._network(depth)

    def warm_up(self) -> None:
        """Run every kernel once on a few invented points, so that no window waits for a compiler."""
        for pair in self._config.pairs:
            search = pair.calibration.search.model_copy(update={"max_evaluations": 20})
            configuration = pair.calibration.model_copy(update={"search": search})
            # An invented window need not lead to a calibration; that it ran is enough.
            with contextlib.suppress(CalibrationError, DecodeError):
                calibrate(_invented_window(rig_of(pair)), _Ramp(), self._images, configuration, Silence())

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Infer the depth of a camera frame (native msgpack) that was chosen for an open window.

        Raises:
            DecodeError: the frame cannot be decoded.
        """
        self._network(self._depth_of_pair[pair]).infer(decode_camera(frame, self._config.limits))

    def solve(self, path: Path) -> Solution:
        """Calibrate a finished window by the configuration it carries, and write the result into its file.

        Raises:
            WindowError, CalibrationError, DecodeError, ModelError: there is no result.
        """
        window, configuration = read_window(path)
        estimate = calibrate(window, self._network(configuration.depth), self._images, configuration, Silence())
        result = result_of(estimate, window.rig, self._config.vehicle)
        try:
            write_result(path, result)
        except (RecordingError, WindowError, OSError) as error:
            _log.warning("the result could not be written into its window", extra={"fields": {"window": path.stem}})
            code = error.reply_code if isinstance(error, CoecError) else "recording_failed"
            return Solution(result, Reason(code, f"The window file does not hold the result: {error}"))
        return Solution(result, None)

    def _network(self, config: DepthConfig) -> CachedDepth:
        if config not in self._networks:
            self._networks[config] = CachedDepth(open_depth(config, self._config.limits), self._depth_maps_kept)
        return self._networks[config]


class _Ramp:
    """Depth that grows from left to right, of any image: for the warm-up."""

    @property
    def identity(self) -> str:
        return "warm-up"

    def infer(self, frame: CameraFrame) -> DepthMap:
        del frame
        height, width = WARM_UP_DEPTH_PX
        return DepthMap(np.tile(np.linspace(1.0, 2.0, width, dtype=np.float32), (height, 1)))


def _invented_window(rig: Rig) -> Window:
    """Two pairs with points all around the LiDAR, seeded."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(WARM_UP_POINTS, 3))
    range_m = rng.uniform(5.0, 30.0, size=(WARM_UP_POINTS, 1))
    xyz_m = (range_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    width, height = rig.camera.width, rig.camera.height
    image = EncodedImage(ImageFormat.MONO8, width, height, rng.bytes(width * height))
    pairs = tuple(
        FramePair(CameraFrame(stamp, rig.camera_frame, image), LidarFrame(stamp, rig.lidar_frame, xyz_m))
        for stamp in (0, 100_000_000)
    )
    return Window("warm-up", rig, rig.T_camera_lidar_nominal, pairs)
