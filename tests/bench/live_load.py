"""The daemon under the load of a vehicle: memory of the I/O process over time, and query round trips during solves.

    .venv/bin/python tests/bench/live_load.py --minutes 10

Starts `coec run --embedded-router`, publishes 10 sweeps (2 MB) and 10 JPEG images (0.5 MB) a second from a process of
their own, keeps the worker solving, and asks for `extrinsic` twenty times a second. No verdict: a table to read.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import multiprocessing.synchronize
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import psutil
import zenoh
from rich.console import Console
from rich.progress import track
from rich.table import Table

from coec.adapters.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.zenoh_client import ask_one, connected
from coec.calibration.values import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame
from coec.schemas.keys import Keys

WIDTH = HEIGHT = 1400
POINTS = 125_000  # at 16 bytes (x y z intensity): 2 MB
JPEG_BYTES = 500_000
PICTURES = 7
QUERY_PERIOD_S = 0.05
NS_PER_S = 1_000_000_000


@dataclass(slots=True)
class Seen:
    """What was measured, minute by minute."""

    idle_ms: list[float] = field(default_factory=list)
    solving_ms: list[float] = field(default_factory=list)
    rss_mb: list[float] = field(default_factory=list)
    cpu_percent: list[float] = field(default_factory=list)


def configuration(port: int, folder: Path) -> str:
    endpoint = f"tcp/127.0.0.1:{port}"
    return f"""
vehicle: bench
zenoh: {{embedded_router: true, listen: ["{endpoint}"], connect: []}}
state: {{directory: {folder / "state"}, max_bytes: 2000000000, min_free_bytes: 0}}
log_level: warning
pairs:
  - name: front
    camera:
      key: sensors/front/camera
      intrinsics: {{model: double_sphere, width: {WIDTH}, height: {HEIGHT}, fx: 440.0, fy: 440.0, cx: 699.5, cy: 699.5,
                   xi: -0.2, alpha: 0.6}}
    lidar: {{key: sensors/front/lidar, sweep: {{period_s: 0.1}}}}
    ego: {{key: sensors/front/ego}}
    T_camera_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    window: {{slice_s: 30, pairs: 25}}
    calibration: {{search: {{dof: 6}}}}
"""


def jpeg(seed: int) -> bytes:
    """A textured picture whose quality is chosen so that it has about `JPEG_BYTES`."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 255, (HEIGHT // 2, WIDTH // 2, 3), np.uint8)
    picture = cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    sizes = {q: cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, q])[1].tobytes() for q in range(20, 96, 5)}
    return min(sizes.values(), key=lambda data: abs(len(data) - JPEG_BYTES))


def publish(port: int, hz: float, stop: multiprocessing.synchronize.Event) -> None:
    """Runs in a process of its own, so that the queries are not slowed by it."""
    rng = np.random.default_rng(1)
    xyz = rng.normal(scale=15.0, size=(POINTS, 3)).astype(np.float32)
    intensity = rng.random(POINTS).astype(np.float32)
    depth = cv2.GaussianBlur(rng.integers(0, 65535, (256, 256), np.uint16), (0, 0), 12)
    depth_png = EncodedImage(ImageFormat.PNG, 256, 256, cv2.imencode(".png", depth)[1].tobytes())
    # More than one, so that the camera does not look frozen.
    images = [EncodedImage(ImageFormat.JPEG, WIDTH, HEIGHT, jpeg(seed)) for seed in range(PICTURES)]
    with connected([f"tcp/127.0.0.1:{port}"], 30.0) as session:
        streams = {
            name: session.declare_publisher(f"sensors/front/{name}", encoding=zenoh.Encoding("application/msgpack"))
            for name in ("ego", "lidar", "camera")
        }
        start_s, count = time.monotonic(), 0
        while not stop.wait(max(start_s + count / hz - time.monotonic(), 0.0)):
            stamp = time.time_ns()
            ego = EgoMotion(stamp, "ego", (10.0, 0.0, 0.0), (0.0, 0.0, 0.1), count)
            streams["ego"].put(encode_ego(ego))
            streams["lidar"].put(encode_lidar(LidarFrame(stamp, "lidar", xyz, intensity, sequence=count)))
            picture = images[count % PICTURES]
            streams["camera"].put(encode_camera(CameraFrame(stamp, "camera", picture, count, depth_png)))
            count += 1


def measure(minutes: float, hz: float, port: int, daemon: subprocess.Popen[bytes]) -> tuple[Seen, dict[str, object]]:
    keys, process, seen = Keys("coec", "bench"), psutil.Process(daemon.pid), Seen()
    with connected([f"tcp/127.0.0.1:{port}"], 60.0) as session:
        session.liveliness().get(keys.alive("front"))
        next_status = next_command = 0.0
        solving = False
        process.cpu_percent()
        end_s = time.monotonic() + 60.0 * minutes
        steps = track(range(int(60.0 * minutes / QUERY_PERIOD_S)), "under load", console=Console(stderr=True))
        for _ in steps:
            now_s = time.monotonic()
            if now_s > end_s:
                break
            start_s = time.perf_counter()
            ask_one(session, keys.extrinsic("front"), 5.0)
            (seen.solving_ms if solving else seen.idle_ms).append(1e3 * (time.perf_counter() - start_s))
            if now_s >= next_status:
                status = json.loads(ask_one(session, keys.status + "?format=json", 5.0).payload)
                solving = status["worker"]["state"] == "busy"
                seen.rss_mb.append(process.memory_info().rss / 1e6)
                seen.cpu_percent.append(process.cpu_percent())
                next_status = now_s + 1.0
            if now_s >= next_command and not solving and now_s > end_s - 45.0 * minutes:
                session.get(keys.command("front", "calibrate"))  # keeps the worker at work; the answer does not matter
                next_command = now_s + 1.0
            time.sleep(max(QUERY_PERIOD_S - (time.monotonic() - now_s), 0.0))
        final = json.loads(ask_one(session, keys.status + "?format=json", 5.0).payload)
    assert hz > 0
    return seen, final


def table(seen: Seen, final: dict[str, object], minutes: float) -> Table:
    shown = Table("what", "figure", title=f"{minutes:g} minutes at 10 Hz × (2 MB cloud + 0.5 MB JPEG)")

    def percentiles(values: list[float]) -> str:
        if not values:
            return "none"
        return f"p50 {np.percentile(values, 50):.2f} ms, p99 {np.percentile(values, 99):.2f} ms ({len(values)})"

    quarter = max(len(seen.rss_mb) // 4, 1)
    shown.add_row("query while solving", percentiles(seen.solving_ms))
    shown.add_row("query while the worker is idle", percentiles(seen.idle_ms))
    shown.add_row("I/O process, resident", f"max {max(seen.rss_mb):.0f} MB, end {seen.rss_mb[-1]:.0f} MB")
    means = ", ".join(f"{np.mean(seen.rss_mb[i : i + quarter]):.0f}" for i in range(0, 4 * quarter, quarter))
    shown.add_row("resident by quarter of the run", f"{means} MB")
    shown.add_row("I/O process, one core", f"{np.mean(seen.cpu_percent[1:]):.0f} %")
    pairs = final["pairs"]
    assert isinstance(pairs, list)
    counters = ("camera", "lidar", "pairs", "rejections", "windows", "solved")
    shown.add_row("counters", json.dumps({name: pairs[0][name] for name in counters}))
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--hz", type=float, default=10.0)
    options = parser.parse_args()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "coec.yaml"
        file.write_text(configuration(port, Path(folder)))
        daemon = subprocess.Popen([sys.executable, "-m", "coec", "run", "--config", str(file)])
        context = multiprocessing.get_context("spawn")
        stop = context.Event()
        publisher = context.Process(target=publish, args=(port, options.hz, stop))
        publisher.start()
        try:
            seen, final = measure(options.minutes, options.hz, port, daemon)
        finally:
            stop.set()
            publisher.join(10)
            daemon.terminate()
            daemon.wait(20)
    Console().print(table(seen, final, options.minutes))


if __name__ == "__main__":
    main()
