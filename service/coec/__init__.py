"""Continuous online extrinsic calibration of a camera and a LiDAR, for a program.

    import coec

    drive = coec.open("drive.mcap")
    result = drive.calibrate()
    if result.accepted:
        result.export("calibration.urdf", format="urdf", parent="lidar", child="camera")

`coec.open` returns a `Recording`. `coec.calibrate` calibrates its windows. A `Result` contains the pose of the camera,
its uncertainty and the verdict. `coec.client.Vehicle` queries a running service. Every exception that coec raises
deliberately is a `CoecError`.

Conventions: `T_camera_lidar` (4, 4) maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y
down, z forward), metres. Corrections and standard deviations are about and along the camera axes, rotations first.
Stamps are integer nanoseconds. Angles are in radians, and in degrees where a name or a docstring says so.

Stability: the public interface is the names in `coec.__all__` and `coec.client.__all__`, with all attributes that have
no underscore and whose docstring does not exclude them, and the models of `coec.schemas` that they return. Within a
minor version (0.1.x) nothing is removed or changes its meaning; attributes and keyword arguments may be added. A
removal is announced at least one minor version before (a `DeprecationWarning` names the replacement). Other modules,
texts of messages, and the last digits of a result may change: another version of coec, numba or the network may compute
differently; `config_hash` or the version shows it.

`import coec` takes milliseconds: numerical modules are imported on first use.
"""

import os

from coec.errors import (
    CalibrationError,
    CoecError,
    ConfigError,
    ConnectionFailedError,
    DecodeError,
    ModelError,
    NotAcceptedError,
    NotFoundError,
    NotProvenError,
    OutputError,
    RecordingError,
    RemoteError,
    SourceError,
    StateError,
    UnavailableError,
    UsageError,
    WindowError,
)

__version__ = "0.1.0"

__all__ = [
    "CalibrationConfig",
    "CalibrationError",
    "CalibrationOptions",
    "CoecError",
    "ConfigError",
    "ConnectionFailedError",
    "DecodeError",
    "Description",
    "ModelError",
    "NotAcceptedError",
    "NotFoundError",
    "NotProvenError",
    "OutputError",
    "Recording",
    "RecordingError",
    "RemoteError",
    "Result",
    "SolverOptions",
    "SourceError",
    "StateError",
    "UnavailableError",
    "UsageError",
    "Window",
    "WindowError",
    "__version__",
    "calibrate",
    "client",
    "evaluate",
    "open",
]

# onnxruntime reports to its vendor over the internet unless this is set before it is imported. A vehicle's service
# connects to nobody but those that it is configured for.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

# The threading layer of parallel kernels, which numba reads when it is imported; processes that are started inherit it.
# By default numba prefers TBB where a library of that name is installed, as it is with OpenCV or ROS on Debian. A
# program then never ends, because TBB's threads spin at its exit. GNU OpenMP is safe for kernels called from several
# threads; numba's own queue, which takes its place on a system without libgomp, ends such a program. Both are equally
# quick and give the same bits. A choice of the user, here or in NUMBA_THREADING_LAYER, wins.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")

_LAZY_NAMES = {
    "CalibrationConfig": "coec.config",
    "CalibrationOptions": "coec.calibration_options",
    "Description": "coec.recording",
    "Recording": "coec.recording",
    "Result": "coec.recording",
    "SolverOptions": "coec.calibration_options",
    "Window": "coec.recording",
    "calibrate": "coec.api",
    "open": "coec.api",
}
"""Public names that are imported when they are first used, and the module of each."""

_ADDED = ("evaluate",)
"""Public names that another package adds, by the entry points of group `coec.api`."""

TYPE_CHECKING = False  # as `typing` has it, which takes longer to import than everything here
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from coec import client
    from coec.api import calibrate, open
    from coec.calibration_options import CalibrationOptions, SolverOptions
    from coec.config import CalibrationConfig
    from coec.recording import Description, Recording, Result, Window

    evaluate: Callable[..., Any]  # of another package
else:  # hidden from type checkers: with this function in sight they would accept every misspelt name

    def __getattr__(name: str) -> object:
        """Imports `client`, or one of the public names that take long to import (PEP 562)."""
        from importlib import import_module

        if name == "client":
            return import_module("coec.client")
        if name in _LAZY_NAMES:
            value: object = getattr(import_module(_LAZY_NAMES[name]), name)
        elif name in _ADDED:
            value = import_module("coec.api").added(name)
        else:
            raise AttributeError(f"module 'coec' has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
