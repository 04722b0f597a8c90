"""A vehicle that sends small frames at full rate for as long as it is let, and knows how many it sent."""

from __future__ import annotations

import threading
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame
from coec.config import Config
from coec.io.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.io.zenoh.bus import MSGPACK
from coec.io.zenoh.ros_node import has_subscribers
from coec.reports.commented_yaml import commented_yaml
from support.fake_worker import wait_until

NS_PER_S = 1_000_000_000
TICK_HZ = 20
"""Pictures; a sweep with every second one, ego-motion with each."""

BEGIN_NS = 1_700_000_000 * NS_PER_S
WIDTH, HEIGHT, POINTS, SCENES = 64, 48, 600, 16
CAMERA, LIDAR, EGO = "camera", "lidar", "ego"
LENS = {"fx": 40.0, "fy": 40.0, "cx": 31.0, "cy": 23.0}
NOMINAL = [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def configured(folder: Path, endpoint: str) -> Path:
    """A configuration for it: short windows and checks, so that there is always something to do."""
    pair = {
        "name": "front",
        "camera": {
            "key": f"in/{CAMERA}",
            "intrinsics": {"model": "pinhole", "width": WIDTH, "height": HEIGHT, **LENS},
        },
        "lidar": {"key": f"in/{LIDAR}"},
        "ego": {"key": f"in/{EGO}"},
        "T_camera_lidar": NOMINAL,
        "window": {"pairs": 10, "min_pairs": 5, "slice_s": 12.0, "min_sharpness": 0.0, "min_mean_level": 0.0,
                   "max_clipped": 1.0, "min_points_in_view": 1},
        "monitor": {"period_s": 3.0, "pairs": 5, "min_pairs": 4, "urgent_slice_s": 6.0},
        "calibration": {"depth": {"model": "stereo"}, "objective": {"kind": "mi"}, "search": {"max_evaluations": 40}},
    }  # fmt: skip
    config = Config.model_validate(
        {
            "zenoh": {"connect": (endpoint,), "listen": (endpoint,)},
            "state": {"directory": "state", "min_free_bytes": 0, "max_bytes": 32 * 2**20},
            "pairs": [pair],
        }
    )
    path = folder / "coec.yaml"
    path.write_text(commented_yaml(config))
    return path


class Vehicle:
    """Sends from a thread of its own.

    Attributes:
        sent: frames of each stream, numbered and not.
    """

    def __init__(self, session: zenoh.Session, seed: int, points: int = POINTS) -> None:
        """`points` of a sweep."""
        self.sent: Counter[str] = Counter()
        self._numbers: Counter[str] = Counter()
        self._shift_ns = 0
        self._stop = threading.Event()
        self._publishers = {
            stream: session.declare_publisher(f"in/{stream}", congestion_control=zenoh.CongestionControl.BLOCK)
            for stream in (CAMERA, LIDAR, EGO)
        }
        rng = np.random.default_rng(seed)
        self._scenes = [_scene(rng, points) for _ in range(SCENES)]
        self._ticks = 0
        self._thread = threading.Thread(target=self._run, name="vehicle")

    def start(self) -> None:
        """Begin as soon as somebody listens: nobody can know of what was sent before."""
        wait_until(lambda: all(has_subscribers(one) for one in self._publishers.values()), "somebody who listens")
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def step_time(self, seconds: float) -> None:
        """The clock of the sensors steps."""
        self._shift_ns += round(seconds * NS_PER_S)

    def put(self, stream: str, payload: bytes) -> None:
        """Whatever it is, it counts as sent. From the thread of who sends it; it is no frame of the vehicle's and has
        no number: nobody could know of one that was sent while the router was away."""
        wait_until(lambda: has_subscribers(self._publishers[stream]), "the router back")
        self._publishers[stream].put(payload, encoding=MSGPACK)
        self.sent[f"{stream} of others"] += 1

    def _run(self) -> None:
        begin_s = time.monotonic()
        while not self._stop.wait(max(begin_s + self._ticks / TICK_HZ - time.monotonic(), 0.0)):
            self._tick()
        if self._ticks % 2 == 0:  # with the sweep of the last picture: without one it would wait for it
            self._tick()

    def _tick(self) -> None:
        stamp_ns = BEGIN_NS + self._shift_ns + self._ticks * NS_PER_S // TICK_HZ
        image, depth, points = self._scenes[self._ticks % SCENES]
        number = self._numbers
        camera = CameraFrame(stamp_ns, "camera", image, depth=depth, sequence=number[CAMERA])
        self._send(CAMERA, encode_camera(camera))
        if self._ticks % 2 == 0:
            self._send(LIDAR, encode_lidar(LidarFrame(stamp_ns, "lidar", points, sequence=number[LIDAR])))
        motion = EgoMotion(stamp_ns, "base", (8.0, 0.0, 0.0), (0.0, 0.0, 0.0), sequence=number[EGO])
        self._send(EGO, encode_ego(motion))
        self._ticks += 1

    def _send(self, stream: str, payload: bytes) -> None:
        self._publishers[stream].put(payload, encoding=MSGPACK)
        self._numbers[stream] += 1
        self.sent[stream] += 1


def _scene(rng: np.random.Generator, points: int) -> tuple[EncodedImage, EncodedImage, NDArray[np.float32]]:
    """Boxes at different ranges, as picture, depth and points."""
    range_m = np.full((HEIGHT, WIDTH), 40.0)
    grey = rng.integers(90, 110, (HEIGHT, WIDTH)).astype(np.uint8)
    for _ in range(6):
        u, v, half = int(rng.integers(0, WIDTH)), int(rng.integers(0, HEIGHT)), int(rng.integers(4, 10))
        box = (slice(max(v - half, 0), v + half), slice(max(u - half, 0), u + half))
        range_m[box], grey[box] = rng.uniform(5.0, 30.0), rng.integers(0, 255)
    rows, columns = rng.integers(0, HEIGHT, points), rng.integers(0, WIDTH, points)
    z = range_m[rows, columns]
    camera = np.stack([(columns - LENS["cx"]) / LENS["fx"] * z, (rows - LENS["cy"]) / LENS["fy"] * z, z], axis=1)
    lidar = camera[:, [2, 0, 1]] * np.array([1.0, -1.0, -1.0])
    done, png = cv2.imencode(".png", np.round(2e5 / range_m / 256.0).astype(np.uint8))
    assert done
    image = EncodedImage(ImageFormat.MONO8, WIDTH, HEIGHT, grey.tobytes())
    return image, EncodedImage(ImageFormat.PNG, WIDTH, HEIGHT, png.tobytes()), lidar.astype(np.float32)
