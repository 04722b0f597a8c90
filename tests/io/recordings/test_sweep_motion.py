"""A recording without ego-motion: it is measured from its own sweeps."""

from collections.abc import Iterator

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import compensation, sensor_twist
from coec.calibration.rig import nearest_neighbours
from coec.calibration.types import Compensation, LidarFrame
from coec.errors import SourceError
from coec.io.recordings.window_cutting import LoadedWindow, window_of_recording
from support.simulated_drives import rendered_source

DRIVE = "sim:seed=3&seconds=0.5&camera_hz=10&lidar_hz=10&camera=fisheye320&lidar=32&speed_mps=9"
WITHOUT = f"{DRIVE}&faults=no-ego:0-9"

with_search = pytest.mark.skipif(not nearest_neighbours.installed(), reason="the extra `lidars` is not installed")


def loaded(source: str) -> LoadedWindow:
    return window_of_recording(rendered_source(source), 2, lambda *_: None)


@pytest.mark.fault("a recording of a drive without odometry", "the motion is measured from sweep to sweep")
@with_search
def test_the_motion_is_measured_from_sweep_to_sweep() -> None:
    measured, known = loaded(WITHOUT), loaded(DRIVE)
    assert [one.code for one in measured.recognitions] == ["motion_registered"]
    assert "for 2 of 2 pairs" in measured.recognitions[0].text
    for ours, theirs in zip(measured.window.pairs, known.window.pairs, strict=True):
        assert compensation(ours, measured.window.rig, enabled=True) is Compensation.DONE
        assert ours.motion is not None
        assert theirs.motion is not None
        turn, velocity = sensor_twist(ours.motion, measured.window.rig.T_lidar_ego)
        true_turn, true_velocity = sensor_twist(theirs.motion, known.window.rig.T_lidar_ego)
        np.testing.assert_allclose(turn, true_turn, atol=np.deg2rad(1.5))
        np.testing.assert_allclose(velocity, true_velocity, atol=0.25)


def test_a_recorded_motion_is_not_measured_again() -> None:
    assert not {one.code for one in loaded(DRIVE).recognitions} & {"motion_registered", "motion_unknown"}


def test_without_the_extra_the_report_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nearest_neighbours, "installed", lambda: False)
    window = loaded(WITHOUT)
    (note,) = window.recognitions
    assert note.code == "motion_unknown"
    assert "coec[lidars]" in note.text
    assert all(pair.motion is None for pair in window.window.pairs)


@with_search
def test_damaged_neighbours_leave_the_motion_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = rendered_source(WITHOUT)

    def damaged(_: object) -> Iterator[LidarFrame]:
        raise SourceError("none of 2 clouds can be read")
        yield

    monkeypatch.setattr(type(recording), "sweeps", lambda _, stamps_ns: damaged(stamps_ns))
    window = window_of_recording(recording, 2, lambda *_: None)
    (note,) = window.recognitions
    assert note.code == "motion_unknown"
    assert "Record the odometry" in note.text
    assert [pair.motion for pair in window.window.pairs] == [None, None]


def test_frames_in_two_second_steps_show_no_motion() -> None:
    distant = "sim:seed=3&seconds=4&camera_hz=0.5&lidar_hz=0.5&camera=fisheye320&lidar=32&faults=no-ego:0-9"
    assert loaded(distant).recognitions == ()
