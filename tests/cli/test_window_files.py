"""`calibrate` and `replay` on a recorded window: the decision is in the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli.conftest import SMALL, Coec
from coec.calibration.pipeline import calibrate
from coec.calibration.types import FramePair, Silence
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, ObjectiveConfig, WindowConfig
from coec.errors import SourceError
from coec.geometry import se3
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.mcap.windows import WindowWriter, read_result, read_window, write_result
from coec.io.recordings import window_cutting
from coec.io.recordings.window_cutting import with_thinned_pairs
from coec.io.serialise import result_of
from support.simulated_drives import rendered_source

LIMITS = LimitsConfig()
SHARP_STREET = "sim:seed=1&seconds=70&camera_hz=0.142857&lidar_hz=0.142857&camera=fisheye700&lidar=32&depth=yes"
"""Ten pairs, seven seconds apart."""

CONFIGURATION = CalibrationConfig(
    depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi", depth_bins=24, range_bins=20)
)
"""Not the defaults: what the file says must be used."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A window with its result, as the service leaves it."""
    loaded = window_cutting.load_window(SMALL, None, 25, lambda *_: None)
    window = window_cutting.with_perturbed_start(loaded.window, np.array([0.02, -0.01, 0.01, 0, 0, 0]))
    path = tmp_path_factory.mktemp("windows") / f"{window.window_id}.mcap"
    writer = WindowWriter(
        path, window.rig, window.T_camera_lidar_start, window.window_id, CONFIGURATION, {"vehicle": "v7"}
    )
    for pair in window.pairs:
        writer.add(pair)
    writer.finish()
    read, configuration = read_window(path)
    estimate = calibrate(read, open_depth(configuration.depth, LIMITS), GreyImages(LIMITS), configuration, Silence())
    write_result(path, result_of(estimate, read.rig, "v7"))
    return path


def test_calibrate_reaches_the_recorded_result_to_the_byte(coec: Coec, recorded: Path) -> None:
    outcome = coec("calibrate", recorded, "--json")
    result = read_result(recorded)
    assert outcome.status == 0
    assert result is not None
    report = outcome.document
    report.pop("elapsed_s")
    assert report.pop("mistake") is None
    assert report.pop("recognitions") == []
    assert report.pop("weighed") is None
    assert report == result.model_dump(mode="json")


def test_an_option_overrides_the_recorded_configuration(coec: Coec, recorded: Path) -> None:
    plain = coec("calibrate", recorded, "--json").document
    moved = coec("calibrate", recorded, "--no-motion-compensation", "--json").document
    assert moved["config_hash"] != plain["config_hash"]


def test_perturb_moves_the_recorded_start(coec: Coec, recorded: Path) -> None:
    outcome = coec("calibrate", recorded, "--perturb", "1,0,0")
    start = float(np.degrees(se3.rotation_exp(np.array([0.02, -0.01, 0.01]))[2, 1]))
    assert outcome.status == 0
    assert f"{start + 1:+.1f}" in outcome.out


def test_replay_is_identical(coec: Coec, recorded: Path) -> None:
    outcome = coec("replay", recorded, "--json")
    assert outcome.status == 0
    assert outcome.document["identical"] is True
    assert outcome.document["differences"] == []


def test_replay_of_a_window_that_holds_a_knock_dates_it_by_the_same_pairs(coec: Coec, tmp_path: Path) -> None:
    recording = rendered_source(SHARP_STREET)
    loaded = window_cutting.window_of_recording(recording, 5, lambda *_: None).window
    window = with_thinned_pairs(loaded, recording, WindowConfig(between_s=5.0))
    knock_ns = window.between[2].stamp_ns
    back = se3.exp(np.array([0.0, -np.radians(2.0), 0.0, 0.0, 0.0, 0.0])).astype(np.float32)
    T = window.T_camera_lidar_start.astype(np.float32)

    def displaced(pair: FramePair) -> FramePair:
        """After the knock the sweep lies as if the camera had been turned by two degrees."""
        if pair.stamp_ns < knock_ns:
            return pair
        seen = (pair.lidar.xyz_m @ T[:3, :3].T + T[:3, 3]) @ back[:3, :3].T
        return replace(pair, lidar=replace(pair.lidar, xyz_m=((seen - T[:3, 3]) @ T[:3, :3]).astype(np.float32)))

    path = tmp_path / f"{window.window_id}.mcap"
    start = window.T_camera_lidar_start
    configuration = CalibrationConfig(depth=DepthConfig(model="stereo"))
    writer = WindowWriter(path, window.rig, start, window.window_id, configuration, {})
    for pair in sorted((*window.pairs, *window.between), key=lambda pair: pair.stamp_ns):
        add = writer.add_between if pair in window.between else writer.add
        add(displaced(pair))
    writer.finish()
    read, _ = read_window(path)
    depth = open_depth(configuration.depth, LIMITS)
    estimate = calibrate(read, depth, GreyImages(LIMITS), configuration, Silence())
    assert estimate.moved is not None
    assert (estimate.moved.last_before_ns, estimate.moved.first_after_ns) == (window.pairs[2].stamp_ns, knock_ns)
    write_result(path, result_of(estimate, read.rig, "v7"))
    outcome = coec("replay", path, "--json")
    assert outcome.status == 0
    assert outcome.document["identical"] is True


def test_replay_names_the_fields_that_differ(coec: Coec, recorded: Path, tmp_path: Path) -> None:
    result = read_result(recorded)
    assert result is not None
    altered = tmp_path / recorded.name
    altered.write_bytes(recorded.read_bytes())
    write_result(altered, result.model_copy(update={"evaluations": result.evaluations + 1}))
    outcome = coec("replay", altered, "--json")
    assert outcome.status == 1
    assert outcome.document["differences"] == [
        {"field": "evaluations", "recorded": result.evaluations + 1, "reached": result.evaluations}
    ]
    assert "evaluations" in coec("replay", altered).out


def test_replay_without_a_result_says_so(coec: Coec, tmp_path: Path) -> None:
    window = window_cutting.load_window(SMALL, 1, 25, lambda *_: None).window
    path = tmp_path / "bare-1.mcap"
    writer = WindowWriter(path, window.rig, window.T_camera_lidar_start, "bare-1", CONFIGURATION, {})
    writer.add(window.pairs[0])
    writer.finish()
    outcome = coec("replay", path)
    assert outcome.status == 1
    assert "holds no result" in outcome.err


@pytest.mark.fault("a damaged window is replayed", "the message says where it is damaged")
def test_replay_of_a_damaged_window(coec: Coec, recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recorded.read_bytes()[:-100])
    outcome = coec("replay", path, "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "bad_window"


def test_slices_of_a_recorded_window_are_counted_from_its_first_pair(recorded: Path) -> None:
    whole = window_cutting.load_window(str(recorded), None, 25, lambda *_: None).window.pairs
    span_s = (whole[-1].stamp_ns - whole[0].stamp_ns) * 1e-9
    half = window_cutting.load_window(str(recorded), None, 25, lambda *_: None, (0.0, span_s / 2)).window.pairs
    assert [pair.stamp_ns for pair in half] == [
        pair.stamp_ns for pair in whole if (pair.stamp_ns - whole[0].stamp_ns) * 1e-9 <= span_s / 2
    ]
    assert 0 < len(half) < len(whole)
    with pytest.raises(SourceError, match="no pair was recorded"):
        window_cutting.load_window(str(recorded), None, 25, lambda *_: None, (span_s + 1.0, span_s + 2.0))


def test_slices_of_a_recording_choose_among_their_own_frames() -> None:
    whole = window_cutting.load_window(SMALL, None, 25, lambda *_: None).window.pairs
    # A frame every two seconds.
    later = window_cutting.load_window(SMALL, 2, 25, lambda *_: None, (3.0, 9.0)).window.pairs
    assert [pair.stamp_ns for pair in later] == [whole[2].stamp_ns, whole[4].stamp_ns]


def test_export_of_a_window_knows_the_lens(coec: Coec, recorded: Path) -> None:
    outcome = coec("export", recorded, "--format", "json")
    result = read_result(recorded)
    assert result is not None
    np.testing.assert_array_equal(outcome.document["T_child_parent"], result.camera_from_lidar.matrix)
    assert outcome.document["camera"]["width"] == read_window(recorded)[0].rig.camera.width
