"""Pairs between those of a window, from a recording that holds more."""

from coec.calibration.types import Window
from coec.config import WindowConfig
from coec.io.recordings.window_cutting import window_of_recording, with_thinned_pairs
from support.simulated_drives import rendered_source

STREET = "sim:seed=1&seconds=40&camera_hz=0.2&lidar_hz=0.2&camera=fisheye320&lidar=32&depth=yes"
"""Eight pairs, five seconds apart."""


def stamps_s(window: Window) -> tuple[list[float], list[float]]:
    return [p.stamp_ns / 1e9 for p in window.pairs], [p.stamp_ns / 1e9 for p in window.between]


def test_what_lies_between_the_selected_pairs_is_thinned_and_comes_along() -> None:
    recording = rendered_source(STREET)
    window = window_of_recording(recording, 2, lambda *_: None).window
    (first, last), none = stamps_s(window)
    assert none == []
    with_them = with_thinned_pairs(window, recording, WindowConfig(between_s=1.0))
    assert with_them.pairs == window.pairs
    _, every = stamps_s(with_them)
    assert len(every) == 6
    assert first < every[0] < every[-1] < last
    assert all(pair.camera.depth is None and pair.lidar.intensity is None for pair in with_them.between)
    _, some = stamps_s(with_thinned_pairs(window, recording, WindowConfig(between_s=10.0)))
    assert some == every[1::2]


def test_there_are_none_where_the_window_holds_every_pair() -> None:
    recording = rendered_source(STREET)
    window = window_of_recording(recording, 8, lambda *_: None).window
    assert with_thinned_pairs(window, recording, WindowConfig(between_s=1.0)).between == ()
