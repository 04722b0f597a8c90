"""Every known input, and some mutations of each kind, keep the promise: a value or an error of ours, soon, in little
memory. `tests/fuzz/run` looks for more of them, and so does the long form here."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fuzz.corpus import MAX_RETAINED_BYTES, inputs_of
from fuzz.loop import MAX_BYTES, MAX_CPU_S, Fuzzer, Report, tried
from fuzz.targets import TARGETS

MUTATIONS = 12
"""Of a target, beside what is known: the same in every run."""

LONG_S = float(os.environ.get("COEC_FUZZ_SECONDS", "10"))
"""Of the long form, for each target."""

Replay = Callable[[str], None]


@pytest.fixture(autouse=True)
def _silent() -> Iterator[None]:
    """What the readers log of every input is read by nobody, and takes as long as reading."""
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture
def held(tmp_path: Path, record_property: Callable[[str, object], None]) -> Replay:
    """Holds a target to the promise with what is known, and some mutations of it."""

    def replay(name: str) -> None:
        target = TARGETS[name]
        known = inputs_of(target)
        fuzzer = Fuzzer(target, tmp_path, seed=0)
        fuzzer.report.corpus = known
        inputs = [*known, *(fuzzer.next() for _ in range(MUTATIONS))]
        slowest_s, most_bytes = 0.0, 0
        for data in inputs:
            trial = tried(target, data, tmp_path)
            assert trial.problem is None, f"{data[:200]!r}: {trial.problem}"
            slowest_s, most_bytes = max(slowest_s, trial.cpu_s), max(most_bytes, trial.grown_bytes)
        record_property("figure", f"{len(inputs)} inputs, {slowest_s * 1e3:.1f} ms and {most_bytes >> 20} MB at most")
        assert slowest_s < MAX_CPU_S
        assert most_bytes < MAX_BYTES

    return replay


@pytest.mark.fault(
    "CameraInfo, /tf_static and nominal.json, of any bytes", "a value or an error of ours, within 5 s and 500 MB"
)
def test_nominal(held: Replay) -> None:
    held("nominal")


@pytest.mark.fault("a camera frame in msgpack, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_camera(held: Replay) -> None:
    held("camera")


@pytest.mark.fault("a LiDAR frame in msgpack, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_lidar(held: Replay) -> None:
    held("lidar")


@pytest.mark.fault("ego-motion in msgpack, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_ego(held: Replay) -> None:
    held("ego")


@pytest.mark.fault("a cloud that is packed, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_packed(held: Replay) -> None:
    held("packed")


@pytest.mark.fault("messages of an odometry, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_odometry(held: Replay) -> None:
    held("odometry")


@pytest.mark.fault("a ROS message of any type, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_cdr(held: Replay) -> None:
    held("cdr")


@pytest.mark.fault("transforms on /tf, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_transforms(held: Replay) -> None:
    held("transforms")


@pytest.mark.fault("a PCD file, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_pcd(held: Replay) -> None:
    held("pcd")


def test_ros1(held: Replay) -> None:
    held("ros1")


def test_translated(held: Replay) -> None:
    held("translated")


@pytest.mark.fault("a stream of video, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_video(held: Replay) -> None:
    held("video")


def test_packets(held: Replay) -> None:
    held("packets")


def test_ply(held: Replay) -> None:
    held("ply")


@pytest.mark.fault("a LAS file, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_las(held: Replay) -> None:
    held("las")


def test_bin(held: Replay) -> None:
    held("bin")


@pytest.mark.fault("a `.npy` file, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_npy(held: Replay) -> None:
    held("npy")


@pytest.mark.fault("an `.npz` file, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_npz(held: Replay) -> None:
    held("npz")


@pytest.mark.fault("a `dataset.yaml`, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_manifest(held: Replay) -> None:
    held("manifest")


@pytest.mark.fault(
    "a calibration or time stamps of KITTI, of any bytes", "a value or an error of ours, within 5 s and 500 MB"
)
def test_kitti(held: Replay) -> None:
    held("kitti")


@pytest.mark.fault("a ROS 2 bag in MCAP, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_bag(held: Replay) -> None:
    held("bag")


@pytest.mark.fault("a recorded window, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_window(held: Replay) -> None:
    held("window")


@pytest.mark.fault("a key and its parameters, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_selector(held: Replay) -> None:
    held("selector")


@pytest.mark.fault("a command and its sender, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_command(held: Replay) -> None:
    held("command")


@pytest.mark.fault("a state file, checksums right, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_state(held: Replay) -> None:
    held("state")


@pytest.mark.fault(
    "the books of the history, hashes right, of any bytes", "a value or an error of ours, within 5 s and 500 MB"
)
def test_books(held: Replay) -> None:
    held("books")


@pytest.mark.fault(
    "a commissioned baseline, checksum right, of any bytes", "a value or an error of ours, within 5 s and 500 MB"
)
def test_baseline(held: Replay) -> None:
    held("baseline")


@pytest.mark.fault("a configuration in YAML, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_configuration(held: Replay) -> None:
    held("configuration")


@pytest.mark.fault("a Zenoh file in JSON5, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_zenoh(held: Replay) -> None:
    held("zenoh")


@pytest.mark.fault("the card of a depth network, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_model_card(held: Replay) -> None:
    held("model_card")


@pytest.mark.fault("an answer of the worker, of any bytes", "a value or an error of ours, within 5 s and 500 MB")
def test_worker(held: Replay) -> None:
    held("worker")


def test_no_target_is_left_out() -> None:
    assert {f"test_{name}" for name in TARGETS} <= globals().keys()


@pytest.mark.parametrize("name", TARGETS)
def test_what_a_target_begins_with_is_taken(tmp_path: Path, name: str) -> None:
    refused = [data for data in TARGETS[name].seeds() if not tried(TARGETS[name], data, tmp_path).accepted]
    assert not refused


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_retained_is_small(name: str) -> None:
    made_by_hand = len(TARGETS[name].seeds())
    assert all(len(data) <= MAX_RETAINED_BYTES for data in inputs_of(TARGETS[name])[made_by_hand:])


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_fuzzed_for_longer(tmp_path: Path, name: str) -> None:
    """In this process: what ends it, ends the run. `tests/fuzz/run` gives every target one of its own."""
    fuzzer = Fuzzer(TARGETS[name], tmp_path, seed=time.time_ns())
    fuzzer.replay(inputs_of(TARGETS[name]))
    end_s = time.monotonic() + LONG_S

    def enough(report: Report) -> bool:
        return bool(report.findings) or time.monotonic() > end_s

    report = fuzzer.mutate(enough)
    print(f"\n{name}: {report.figure}")
    assert not report.findings, [(one.text, one.data) for one in report.findings.values()]
