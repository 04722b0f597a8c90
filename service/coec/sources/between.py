"""Adds to a window the thinned pairs between its own, from a recording that holds more than the window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from coec.adapters.images.codec import CompressingReducer
from coec.calibration.frames.between import NS_PER_S_BETWEEN, BetweenPairs
from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import FramePair, Window
from coec.config import LimitsConfig, PairingConfig, WindowConfig
from coec.geometry.culling import half_field_of_view_rad
from coec.sources import RecordingSource
from coec.sources.windows import RECORDED_GAP_S


def with_thinned_pairs(window: Window, recording: RecordingSource, config: WindowConfig) -> Window:
    """The window with the pairs between its own that the daemon would have recorded, taken from a recording that holds
    them. The window's slice runs from its first to its last pair.

    Raises:
        SourceError: a file cannot be read.
    """
    stamps_ns = [pair.stamp_ns for pair in window.pairs]
    rig = window.rig
    lit = rig.mask if rig.mask is not None else np.ones((rig.camera.height, rig.camera.width), np.bool_)
    picked = BetweenPairs(CompressingReducer(LimitsConfig()), half_field_of_view_rad(rig.camera, lit))
    # From the first of n pairs to the last there are n - 1 intervals; a slice of n pairs has n.
    of_window = config.model_copy(update={"pairs": max(1, len(stamps_ns) - 1)})
    picked.begin(of_window, stamps_ns[0], stamps_ns[-1] - stamps_ns[0])
    own, between = set(stamps_ns), []
    for pair in _pairs(recording, window, config):
        if pair.stamp_ns in own:
            picked.on_selected(pair.stamp_ns)
        elif (thinned := picked.offer(pair, window.T_camera_lidar_start)) is not None:
            between.append(thinned)
    return replace(window, between=tuple(between))


def _pairs(recording: RecordingSource, window: Window, config: WindowConfig) -> list[FramePair]:
    """The pairs of the window, and those between them at the configured distance (`between_s`)."""
    own, selected, last_ns = {pair.stamp_ns for pair in window.pairs}, [], window.pairs[0].stamp_ns
    for index, stamp_ns in enumerate(recording.camera_stamps_ns):
        if not window.pairs[0].stamp_ns <= stamp_ns <= window.stamp_ns:
            continue
        if stamp_ns in own or stamp_ns - last_ns >= round(config.between_s * NS_PER_S_BETWEEN):
            selected.append(index)
            last_ns = stamp_ns
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=True)
    pairs = [pair for message in recording.messages(selected) for pair in pairer.push(message)]
    return [*pairs, *pairer.flush()]
