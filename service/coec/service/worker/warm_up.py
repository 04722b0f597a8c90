"""The warm-up of a worker: runs every kernel once on a few invented points, so that no work waits for a compiler. What
a check needs comes first, because windows take longer to come. The kernels that a solve uses after its edges are
extracted take half of the compiling time; `late_kernels` runs each of them on tiny inputs.

If there is a second processor, a second process compiles kernels meanwhile, from those on that the warm-up needs last.
Each finds the other's kernels in the cache on the disk, so they meet somewhere in the middle without dividing the work
beforehand. It is started as `python -m coec.service.worker.warm_up PARENT`, with the configuration on its standard
input.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from coec.calibration import types
from coec.calibration.monitor.check_verdict import MIN_PAIRS, diagnose
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.search.global_search import sample_reach
from coec.calibration.solver import prepare_window_data, solve
from coec.config import CalibrationConfig, Config
from coec.errors import CalibrationError, DecodeError
from coec.geometry import compilation_events
from coec.geometry.cameras import Camera, scaled
from coec.geometry.edges import alignment
from coec.geometry.edges.charts import charted_significances, edge_charts, pattern_search, select_separated
from coec.geometry.edges.displaced_alignment import DisplacedEdges, linearised
from coec.geometry.images import connected_groups
from coec.geometry.mutual_information import BinnedFrames, information_of_each, mutual_information, share_of_pixels
from coec.geometry.projection import project
from coec.io.images import GreyImages, encode_jpeg
from coec.service.worker.child_process import tie_to

LATE_CAMERA_PX = 64
"""Longer side of the image: kernels are compiled for types, not for sizes."""

BLUR_RAD = 0.1
"""Blur that gives a chart of few cells, rad."""


def late_kernels(camera: Camera) -> tuple[Callable[[], object], ...]:
    """The functions to run; those that a solve needs last come first."""
    scale = min(1.0, LATE_CAMERA_PX / max(camera.width, camera.height))
    camera = scaled(camera, scale, scale)
    edges, pose = one_edge(camera), np.eye(4)
    two = np.stack([pose, pose])
    displaced = DisplacedEdges(
        np.zeros((2, 1), np.float32), np.zeros((1, 2, 1), np.float32), edges.weight, np.zeros(1, np.int32), edges.maps
    )
    still = np.zeros((3, 1), np.float32)
    charts = edge_charts(camera, edges.maps, BLUR_RAD, edges.xyz_m, edges.weight, np.zeros(1, np.int64))
    steps, reach = np.full(6, 0.01), np.array([0.01, 0.01])
    binned = _binned(camera)
    values = np.ones((camera.height, camera.width), np.float32)
    return (
        lambda: alignment.ascend(edges, [alignment.AscentStart(pose, 0, 1)], pose[None, None]),
        lambda: displaced.significances(np.zeros((2, 1))),
        lambda: displaced.cell_sums(np.zeros(1, np.int64), 1, np.zeros((1, 1)), 1),
        lambda: linearised(camera, camera, pose, np.zeros(3), edges.xyz_m, still, still, np.zeros(3), 0.0, (0,)),
        lambda: pattern_search(charts, two, steps, 1, pose, reach),
        lambda: charted_significances(charts, two),
        lambda: information_of_each(binned, two),
        lambda: mutual_information(binned, pose),
        lambda: share_of_pixels(values, values > 0.0, np.ones(1, np.float32)),
        lambda: connected_groups(values > 0.0),
        lambda: alignment.significances(edges, two),
        lambda: sample_reach(pose, SearchBox(0.1, 0.0), 8),
        lambda: select_separated(two, np.arange(2), 1, 3.0),
        lambda: alignment.alignments(edges, two),
        lambda: alignment.alignment_of_parts(edges, np.zeros(1, np.uint8), 1, two),
        lambda: project(camera, np.ones((1, 3))),
    )


def one_edge(camera: Camera) -> alignment.EdgeFrames:
    """Input with one range edge, and an image without edges."""
    maps = np.zeros((1, camera.height, camera.width), np.int8)
    return alignment.EdgeFrames(camera, np.ones((3, 1), np.float32), np.ones(1, np.float32), np.array([0, 1]), maps)


def _binned(camera: Camera) -> BinnedFrames:
    """Input with one point, and an image of a single depth."""
    return BinnedFrames(
        camera=camera,
        xyz_m=np.ones((3, 1), np.float32),
        range_bin=np.zeros(1, np.uint8),
        first_point=np.array([0, 1]),
        depth_bin=np.zeros((1, camera.height * camera.width + 1), np.uint8),
        depth_bins=1,
        range_bins=1,
    )


POINTS = 2000
DEPTH_PX = (48, 64)

CAMERA_PX = 128
"""Longer side of the images of the warm-up. Kernels are compiled for types, not for sizes, and a few milliseconds of
work at this size would be more than a second at the size of a camera's images."""

EVALUATIONS, REACH_DEG = 4, 4.0
"""Limits of the searches of the warm-up."""


def warm_up_check(rig: types.Rig, calibration: CalibrationConfig, images: GreyImages) -> None:
    """Runs the kernels that a check of one pair uses."""
    rig = small(rig)
    with contextlib.suppress(CalibrationError, DecodeError):
        diagnose(invented_window(rig), _Ramp(), images, _short(calibration), None)


def warm_up_solve(rig: types.Rig, calibration: CalibrationConfig, images: GreyImages) -> Iterator[None]:
    """Runs the kernels that the solve of a window of one pair uses, a few seconds of compiling in each step."""
    rig = small(rig)
    for run in reversed(late_kernels(rig.camera)):
        run()
        yield
    short = _short(calibration)
    with contextlib.suppress(CalibrationError, DecodeError):
        solve(prepare_window_data(invented_window(rig), _Ramp(), images, short, types.Silence()), short)
    # These two kernels compute the uncertainty of a result, which takes long where nothing fits.
    project(rig.camera, np.ones((1, 3)))
    alignment.alignment_of_parts(one_edge(rig.camera), np.zeros(1, np.uint8), 1, np.eye(4)[None])
    yield


def _short(calibration: CalibrationConfig) -> CalibrationConfig:
    search = calibration.search.model_copy(update={"max_evaluations": EVALUATIONS, "reach_deg": REACH_DEG})
    return calibration.model_copy(update={"search": search})


class _Ramp:
    """A depth network that gives the same map for every image: depth grows from left to right."""

    @property
    def identity(self) -> str:
        return "warm-up"

    def infer(self, frame: types.CameraFrame) -> types.DepthMap:
        del frame
        height, width = DEPTH_PX
        return types.DepthMap(np.tile(np.linspace(1.0, 2.0, width, dtype=np.float32), (height, 1)))


def small(rig: types.Rig) -> types.Rig:
    """The rig with a camera of fewer pixels and the same field of view. One corner is masked, so that code for the
    borders of masks runs, too."""
    scale = min(1.0, CAMERA_PX / max(rig.camera.width, rig.camera.height))
    camera = scaled(rig.camera, scale, scale)
    mask = np.ones((camera.height, camera.width), np.bool_)
    mask[0, 0] = False
    return replace(rig, camera=camera, mask=mask)


def invented_window(rig: types.Rig) -> types.Window:
    """A window with random points all around the LiDAR, from a fixed seed. Its arrays are like those of a window from
    the disk, so that the kernels are compiled for the same types: read-only sweeps, images from a decoder, motion to
    compensate."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(POINTS, 3))
    range_m = rng.uniform(5.0, 30.0, size=(POINTS, 1))
    xyz_m = (range_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    reflectance = rng.random(POINTS, dtype=np.float32)
    xyz_m.setflags(write=False)
    width, height = rig.camera.width, rig.camera.height
    jpeg = encode_jpeg(rng.integers(0, 256, (height, width), np.uint8))
    image = types.EncodedImage(types.ImageFormat.JPEG, width, height, jpeg)
    pairs = tuple(
        types.FramePair(
            types.CameraFrame(stamp, rig.camera_frame, image),
            types.LidarFrame(stamp, rig.lidar_frame, xyz_m, intensity=reflectance),
            types.EgoMotion(stamp, "ego", (1.0, 0.0, 0.0), (0.0, 0.0, 0.1)),
        )
        for stamp in range(0, MIN_PAIRS * 100_000_000, 100_000_000)
    )
    return types.Window("warm-up", rig, rig.T_camera_lidar_nominal, pairs)


@contextmanager
def second_compiler(config: Config) -> Iterator[None]:
    """Within the block, the first kernel that has to be compiled starts the second process. If that process fails, the
    worker only needs more time."""
    children: list[subprocess.Popen[bytes]] = []

    def on_compilation(_: str) -> None:
        if not children and len(os.sched_getaffinity(0)) > 1:
            children.append(_started(config))

    try:
        with compilation_events.listening(on_compilation):
            yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def _started(config: Config) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", __name__, str(os.getpid())]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    assert child.stdin is not None
    with contextlib.suppress(OSError), child.stdin:
        child.stdin.write(config.model_dump_json().encode())
    return child


def main(arguments: list[str]) -> int:
    """Compiles the kernels for one camera of each lens model."""
    (parent,) = (int(argument) for argument in arguments)
    tie_to(parent)
    config = Config.model_validate_json(sys.stdin.buffer.read())
    from coec.io.rig_files import rig_of

    cameras = {type(camera): camera for camera in (rig_of(pair).camera for pair in config.pairs)}
    for camera in cameras.values():
        for run in late_kernels(camera):
            run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
