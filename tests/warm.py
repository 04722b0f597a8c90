"""Makes what many test files need, before several processes start that would each make it at the same time: compiled
kernels and drawn drives, in two processes. Nothing depends on it: what is not there is made by whoever needs it first.

`python tests/warm.py`; takes four seconds of a core where all is there.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

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
from coec.service.worker.tasks import Solver
from support.simulated_drives import rendered_source


def small_lens(model: str, **parameters: float) -> CameraIntrinsics:
    """A lens of a small picture."""
    size = {"width": 160, "height": 120, "fx": 60.0, "fy": 60.0, "cx": 79.5, "cy": 59.5}
    return CameraIntrinsics.model_validate({"model": model, **size, **parameters})


LENSES = (
    small_lens("pinhole"),
    small_lens("kannala_brandt", k1=0.0, k2=0.0, k3=0.0, k4=0.0),
    small_lens("mei", xi=1.5, k1=0.0, k2=0.0, p1=0.0, p2=0.0),
    small_lens("eucm", alpha=0.5, beta=1.0),
    small_lens("double_sphere", xi=0.0, alpha=0.5),
)
"""A kernel is compiled for each of the models that the tests calibrate with."""

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def pair_configs(lenses: Sequence[CameraIntrinsics]) -> Iterator[PairConfig]:
    """One of each."""
    calibration = CalibrationConfig(depth=DepthConfig(model="stereo"), search=SearchConfig(dof=6))
    for camera in lenses:
        yield PairConfig(
            name=camera.model,
            camera=CameraConfig(key=f"{camera.model}/camera", intrinsics=camera),
            lidar=LidarConfig(key=f"{camera.model}/lidar"),
            ego=EgoConfig(key=f"{camera.model}/ego"),
            T_camera_lidar=IDENTITY,
            calibration=calibration,
        )


def render() -> None:
    """The drives of many files."""
    for source in (SMALL, STREET, SHARP_STREET):
        rendered_source(source)


def compile_for(lenses: Sequence[CameraIntrinsics]) -> None:
    """What calibrates with these."""
    Solver(Config(pairs=tuple(pair_configs(lenses))), 1).warm_up()


def main() -> None:
    """What all lenses have in common is compiled with the first."""
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as processes:
        for done in (processes.submit(render), processes.submit(compile_for, LENSES[:1])):
            done.result()
        for done in [processes.submit(compile_for, lenses) for lenses in (LENSES[1:3], LENSES[3:])]:
            done.result()


if __name__ == "__main__":
    main()
