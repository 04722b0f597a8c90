"""Makes what many test files need, before several processes start that would each make it at the same time: compiled
kernels and drawn drives. Nothing depends on it: what is not there is made by whoever needs it first.

`python tests/warm.py`; takes four seconds of a core where all is there.
"""

from __future__ import annotations

from collections.abc import Iterator

from calibration.conftest import SHARP_STREET, STREET
from cli.conftest import SMALL
from coec.config import (
    CalibrationConfig,
    CameraConfig,
    CameraIntrinsics,
    Config,
    DepthConfig,
    EgoConfig,
    LidarConfig,
    PairConfig,
    SearchConfig,
)
from coec.runtime.worker.tasks import Solver
from drives import drawn_source


def lens(model: str, **parameters: float) -> CameraIntrinsics:
    """A lens of a small picture."""
    size = {"width": 160, "height": 120, "fx": 60.0, "fy": 60.0, "cx": 79.5, "cy": 59.5}
    return CameraIntrinsics.model_validate({"model": model, **size, **parameters})


LENSES = (
    lens("pinhole"),
    lens("kannala_brandt", k1=0.0, k2=0.0, k3=0.0, k4=0.0),
    lens("mei", xi=1.5, k1=0.0, k2=0.0, p1=0.0, p2=0.0),
    lens("eucm", alpha=0.5, beta=1.0),
    lens("double_sphere", xi=0.0, alpha=0.5),
)
"""A kernel is compiled for each of the models that the tests calibrate with."""

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def pairs() -> Iterator[PairConfig]:
    """One of each lens."""
    calibration = CalibrationConfig(depth=DepthConfig(model="stereo"), search=SearchConfig(dof=6))
    for camera in LENSES:
        yield PairConfig(
            name=camera.model,
            camera=CameraConfig(key=f"{camera.model}/camera", intrinsics=camera),
            lidar=LidarConfig(key=f"{camera.model}/lidar"),
            ego=EgoConfig(key=f"{camera.model}/ego"),
            T_camera_lidar=IDENTITY,
            calibration=calibration,
        )


def main() -> None:
    """Draws, then compiles."""
    for source in (SMALL, STREET, SHARP_STREET):
        drawn_source(source)
    Solver(Config(pairs=tuple(pairs())), 1).warm_up()


if __name__ == "__main__":
    main()
