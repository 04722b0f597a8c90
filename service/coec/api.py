"""The functions of `coec`: open a recording, calibrate it, and what other packages add."""

from collections.abc import Callable
from os import PathLike, fspath
from typing import Any, Unpack

from coec.calibration_options import CalibrationOptions
from coec.errors import UsageError
from coec.extensions import FUNCTIONS, added_by_packages
from coec.io.recordings.layouts import open_source
from coec.recording import Recording, Result, Window


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


def calibrate(
    window: Window | Recording,
    **options: Unpack[CalibrationOptions],
) -> Result:
    """Finds the pose of the camera against the LiDAR, and judges the result. The same window, network and configuration
    give the same result, to the byte; `coec calibrate` prints the same one. `Result.accepted` says whether to use it:
    a negative verdict is a result, not an error.

    Args:
        window: the frames to calibrate from; a recording stands for its window of `frames` (25) camera frames.
        options: see `CalibrationOptions`.

    Raises:
        TypeError: an option that does not exist.
        UsageError: a value that does not exist.
        SourceError, WindowError: the recording cannot be read.
        ModelError: the depth network is missing, corrupt, or does not match its card.
        CalibrationError: there is no result at all: no pairs, no depth, or no point that any pose brings into view.

    Example:
        >>> import coec
        >>> drive = coec.open("sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes")
        >>> result = coec.calibrate(drive, depth="stereo", objective="mi", perturb=(-2.0, 1.5, 1.0))
        >>> result.accepted, result.T_camera_lidar.shape
        (True, (4, 4))
        >>> bool(abs(result.correction[:3]).max() < 0.35)  # degrees from the simulated truth
        True
    """
    return window.calibrate(**options)


def added(name: str) -> Callable[..., Any]:
    """The function that an installed package adds as `coec.<name>`.

    Without such a package it is a function that raises UsageError, which names what to install.
    """
    load = added_by_packages(FUNCTIONS).get(name)
    if load is not None:
        function: Callable[..., Any] = load()
        return function

    def absent(*_: object, **__: object) -> Any:
        raise UsageError(f"coec.{name} is not installed: it comes with the laboratory, `pip install coec-lab`")

    absent.__doc__ = f"`coec.{name}`: not installed, it comes with the laboratory (`pip install coec-lab`)."
    return absent
