"""The sensors of the benchmark, in a process of their own, until its standard input ends: camera, LiDAR and ego-motion
of one pair at the rates of a vehicle, native msgpack.
"""

from __future__ import annotations

import itertools
import select
import sys
import time
from dataclasses import replace

import zenoh

from coec.adapters.frames.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.zenoh.client import connected
from coec.calibration.types import EgoMotion
from coec.cli.bench import scene

CAMERA_HZ, SWEEP_EVERY = 30.0, 3
"""Images a second, and of how many images each has a sweep: 10 sweeps a second."""

ROOMS = 7
"""Different frames that are sent in turn: a camera that sends one and the same would look frozen."""

CAMERA = "double_sphere"
CONNECT_S = 60.0
SPEED_MPS = 10.0
KEYS = {"camera": "bench/camera", "lidar": "bench/lidar", "ego": "bench/ego"}


def main(endpoint: str) -> int:
    """Publishes until standard input ends; always 0."""
    pairs = [scene.pair(scene.CAMERAS[CAMERA], seed, 0) for seed in range(ROOMS)]
    with connected([endpoint], CONNECT_S) as session:
        encoding = zenoh.Encoding("application/msgpack")
        streams = {name: session.declare_publisher(key, encoding=encoding) for name, key in KEYS.items()}
        begin_s = time.monotonic()
        for count in itertools.count():
            if _ended(begin_s + count / CAMERA_HZ - time.monotonic()):
                return 0
            room, stamp_ns = pairs[count % ROOMS], time.time_ns()
            ego = EgoMotion(stamp_ns, "ego", (SPEED_MPS, 0.0, 0.0), (0.0, 0.0, 0.0), count)
            streams["ego"].put(encode_ego(ego))
            streams["camera"].put(encode_camera(replace(room.camera, stamp_ns=stamp_ns, sequence=count)))
            if count % SWEEP_EVERY == 0:
                sweep = replace(room.lidar, stamp_ns=stamp_ns, sequence=count // SWEEP_EVERY)
                streams["lidar"].put(encode_lidar(sweep))
    return 0


def _ended(wait_s: float) -> bool:
    """Whether standard input ends within so many seconds."""
    readable, _, _ = select.select([sys.stdin], [], [], max(wait_s, 0.0))
    return bool(readable) and not sys.stdin.buffer.read(1)
