"""Continuous online extrinsic calibration of a camera and a LiDAR, for a program.

    import coec

    drive = coec.open("drive.mcap")
    result = drive.calibrate()
    if result.accepted:
        result.export("calibration.urdf", format="urdf", parent="lidar", child="camera")

`coec.open` gives a `Recording`, its windows are calibrated by `coec.calibrate`, and a `Result` says where the camera
is, how sure that is, and whether to use it. `coec.client.Vehicle` asks a service that runs. Everything raised on
purpose is a `CoecError`.

Conventions: `T_camera_lidar` (4, 4) maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y
down, z forward), metres. Corrections and standard deviations are about and along the camera axes, rotations first.
Stamps are integer nanoseconds. Radians inside, degrees where a name or a docstring says so.

Stability: public is what `coec.__all__` and `coec.client.__all__` name, with its attributes that have no underscore
and are not said to be none of it, and the models of `coec.schemas` that it returns. Within a minor version (0.1.x)
nothing of that goes away or changes its meaning; arguments and attributes may be added, arguments by name. What is to
go warns (`DeprecationWarning`, which says what to use instead) for at least one minor version before. Not promised are
other modules, texts of messages, and the last digits of a result: another version of coec, numba or the network may
calculate another way, and says so in `config_hash` or its version.

To import this costs milliseconds: what calculates is imported when it is first used.
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

# onnxruntime reports to its vendor over the internet unless it is told not to before it is imported. A vehicle's
# service speaks to nobody it was not told to.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

_LATER = {
    "CalibrationConfig": "coec.config",
    "Description": "coec.library.recordings",
    "Recording": "coec.library.recordings",
    "Result": "coec.library.results",
    "Window": "coec.library.windows",
    "calibrate": "coec.library.calls",
    "evaluate": "coec.library.calls",
    "open": "coec.library.recordings",
}
"""Where the names are that are imported when they are first used."""

TYPE_CHECKING = False  # as `typing` has it, which takes longer to import than everything here
if TYPE_CHECKING:
    from coec import client
    from coec.config import CalibrationConfig
    from coec.library.calls import calibrate, evaluate
    from coec.library.recordings import Description, Recording, open
    from coec.library.results import Result
    from coec.library.windows import Window
else:  # a checker that saw this would take every misspelt name for one that is there

    def __getattr__(name: str) -> object:
        """The public names that take long to import, and `client` (PEP 562)."""
        from importlib import import_module

        if name == "client":
            return import_module("coec.client")
        if name not in _LATER:
            raise AttributeError(f"module 'coec' has no attribute {name!r}")
        found: object = getattr(import_module(_LATER[name]), name)
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
