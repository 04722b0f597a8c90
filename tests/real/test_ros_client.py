"""A ROS 2 vehicle by a client that is not ours, zenoh-ros2-sdk, with the default session and router of rmw_zenoh: eight
lines of configuration, a router that comes after the service, frames, and what ROS gets when the camera is knocked."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import venv
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from coec.calibration.types import Frame
from coec.config import load_config
from e2e.drives import Drive, rendered, without_depth
from e2e.processes import COMMAND, PATIENCE_S, Service, environment, free_endpoint
from e2e.ros_vehicle import CAMERA, EGO, INFO, POINTS, TF, camera_info, message_of
from e2e.test_pending_pair import reported
from support import ros as rmw_zenoh_defaults
from support.fake_worker import wait_until

pytestmark = pytest.mark.slow

pytest.importorskip("embreex", reason="needs embreex")

CLIENT = "zenoh-ros2-sdk==0.1.8"
VEHICLE = Path(__file__).with_name("ros_sdk_vehicle.py")
LONG_S = 900.0
"""Within this the first start on a busy machine has compiled its kernels."""

SECONDS, KNOCK_S = 110, 60
DRIVE = (
    f"seed=1&seconds={SECONDS}&camera=pinhole480x240&lidar=32&camera_hz=1&lidar_hz=1&ego_hz=10"
    f"&faults=step:{KNOCK_S}:ry=3"
)
CONFIGURATION = """vehicle: shuttle-7
zenoh: {{connect: [{endpoint}]}}
middleware: rmw_zenoh
ros: {{publish: [diagnostics, tf_static, camera_info, overlay]}}
pairs:
  - name: front
    camera: /sensing/camera/front/image_raw/compressed
    points: /sensing/lidar/top/points
    ego: /localization/odometry
    window: {{pairs: 16, min_pairs: 8, slice_s: 32, min_points_in_view: 100}}
state: {{min_free_bytes: 0}}
"""
"""The lines of deploy/ros2, ego-motion, and windows that a drive of two minutes fills."""

KINDS = {
    CAMERA: "sensor_msgs/msg/CompressedImage",
    POINTS: "sensor_msgs/msg/PointCloud2",
    EGO: "nav_msgs/msg/Odometry",
    INFO: "sensor_msgs/msg/CameraInfo",
    TF: "tf2_msgs/msg/TFMessage",
}
OK, ERROR, STALE = 0, 2, 3
CORRECTED_DEG = 0.5


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the client."""
    folder = tmp_path_factory.mktemp("client")
    venv.create(folder, with_pip=True)
    interpreter = folder / "bin" / "python"
    install = [str(interpreter), "-m", "pip", "install", "--quiet", CLIENT]
    done = subprocess.run(install, capture_output=True, text=True, timeout=LONG_S)
    if done.returncode != 0:
        pytest.skip(f"needs {CLIENT} from a package index: connect, or name a mirror to pip ({done.stderr[-300:]})")
    return interpreter


class Vehicle:
    """The process of the client.

    Attributes:
        lines: what it wrote, in order.
    """

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self.lines: list[dict[str, Any]] = []
        self.sent: Counter[str] = Counter()
        self._process, self._folder = process, folder
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def put(self, topic: str, payload: bytes) -> None:
        """Publish a message, and wait until it was."""
        assert self._process.stdin is not None
        file = self._folder / "message"
        file.write_bytes(payload)
        self._process.stdin.write(f"{topic} {KINDS[topic]} {file}\n")
        self._process.stdin.flush()
        self.sent[topic] += 1
        wait_until(lambda: sum("sent" in line for line in list(self.lines)) == self.sent.total(), topic, PATIENCE_S)

    def send(self, frame: Frame) -> None:
        self.put(*message_of(frame))

    def got(self, topic: str) -> list[dict[str, Any]]:
        return [line for line in list(self.lines) if line.get("topic") == topic]

    def levels(self) -> list[int]:
        return [line["level"] for line in self.got("/diagnostics")]

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(PATIENCE_S)

    def end(self) -> None:
        """Close the pipes of a process that has ended."""
        self._thread.join()
        with self._process:
            pass

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self.lines.append(json.loads(line))


@contextmanager
def vehicle(python: Path, folder: Path, endpoint: str) -> Iterator[Vehicle]:
    command = [str(python), str(VEHICLE), endpoint.rpartition(":")[2]]
    with (folder / "vehicle.log").open("w") as log:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
    running = Vehicle(process, folder)
    try:
        wait_until(lambda: {"ready": True} in running.lines, "the client", PATIENCE_S)
        yield running
        running.close()
        assert process.returncode == 0, (folder / "vehicle.log").read_text()
    finally:
        process.kill()
        running.end()


@contextmanager
def started(config: Path) -> Iterator[subprocess.Popen[bytes]]:
    with config.with_name("coec.log").open("wb") as log:
        command = [*COMMAND, "run", "--config", str(config)]
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment(), cwd=config.parent)
    try:
        yield process
    except BaseException:
        sys.stderr.write(config.with_name("coec.log").read_text()[-8000:])
        raise
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def drive() -> Drive:
    return rendered(DRIVE)


@pytest.mark.fault(
    "zenoh-ros2-sdk as vehicle and listener, rmw_zenoh's default router, which comes after the service, and a knock",
    "frames arrive, the calibration and the picture are received, /diagnostics goes to OK and with the knock to ERROR",
)
def test_a_vehicle_of_another_client(python: Path, tmp_path: Path, drive: Drive, record_property: Any) -> None:
    endpoint = free_endpoint()
    config = tmp_path / "coec.yaml"
    config.write_text(CONFIGURATION.format(endpoint=endpoint))
    log = tmp_path / "coec.log"
    rig = drive.recording.rig
    before = without_depth(drive.between(0, KNOCK_S))
    after = without_depth(drive.between(KNOCK_S, SECONDS))
    with started(config) as process:
        wait_until(lambda: f"no router at {endpoint}, trying again" in log.read_text(), "the complaint", LONG_S)
        assert process.poll() is None
        with rmw_zenoh_defaults.rmw_router(endpoint) as router, vehicle(python, tmp_path, endpoint) as ros:
            running = Service(process, router, load_config(config), log)
            wait_until(lambda: STALE in ros.levels(), "/diagnostics before anything was checked", LONG_S)
            running.until(running.status, lambda status: status["state"] == "running", "the worker")
            ros.put(TF, reported(drive))
            ros.put(INFO, camera_info(rig.camera, rig.camera_frame))
            for frame in before[:20]:
                ros.send(frame)
            running.until(running.counters, lambda pair: not pair["awaits"], "the pair is complete")
            running.send_by(ros.send, before)
            running.until(running.extrinsic, lambda reported: reported["status"] == "accepted", "the result")
            error_deg = drive.error_deg(running.extrinsic(), 0)
            child = f"{rig.camera_frame}_calibrated"
            wait_until(lambda: child in [one["child"] for one in ros.got("/tf_static")], "/tf_static", PATIENCE_S)
            running.rest()
            settled = list(ros.levels())
            running.send_by(ros.send, after)
            # On a busy machine the window that corrects the knock may end with the check that notices it. Then the pair
            # is miscalibrated for less than the time between two messages.
            wait_until(
                lambda: (
                    ERROR in ros.levels()[len(settled) :]
                    or drive.error_deg(running.extrinsic(), SECONDS) < CORRECTED_DEG
                ),
                "the knock",
                PATIENCE_S,
            )
            assert "miscalibrated" in [entry["code"] for entry in running.entries("state")]
            wait_until(lambda: bool(ros.got("/coec/front/overlay/compressed")), "the picture", PATIENCE_S)
            wait_until(lambda: bool(ros.got("/coec/front/camera/camera_info")), "the intrinsics", PATIENCE_S)
            assert all(one["jpeg"] for one in ros.got("/coec/front/overlay/compressed"))
            losses = {name: running.counters()[name]["losses"] for name in ("camera", "lidar", "ego")}
            assert running.terminate() == 0
            wait_until(lambda: ros.levels()[-1] == STALE, "stale at the end", PATIENCE_S)
    assert OK in settled, settled
    assert ERROR not in settled
    count = Counter(line["topic"] for line in ros.lines if "topic" in line)
    record_property(
        "figure",
        f"{sum(ros.sent[topic] for topic in (CAMERA, POINTS, EGO))} messages sent, lost {losses}; "
        f"{error_deg:.2f}° after calibration; received {dict(count)}",
    )
