"""A check on its way to the worker and back: nothing is lost, to the bit."""

import msgpack
import numpy as np

from coec.calibration.commissioning.baseline import Drift
from coec.calibration.frames.pairing import Pairer
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import Metric
from coec.config import LimitsConfig, PairingConfig
from coec.runtime.worker.messages import pack_observation, pack_pairs, unpack_observation, unpack_pairs
from drives import drawn_source


def test_pairs_survive() -> None:
    pairer = Pairer(PairingConfig(), expects_motion=True)
    recording = drawn_source("sim:seconds=2&camera_hz=1&lidar_hz=1&camera=fisheye64&lidar=16&depth=yes")
    pairs = [pair for message in recording.messages() for pair in pairer.push(message)]
    pairs += pairer.flush()
    back = unpack_pairs(msgpack.unpackb(msgpack.packb([*pack_pairs(pairs)]), max_bin_len=2**30), LimitsConfig())
    assert len(back) == 2
    for one, other in zip(pairs, back, strict=True):
        assert one.camera == other.camera
        assert one.motion == other.motion
        np.testing.assert_array_equal(one.lidar.xyz_m, other.lidar.xyz_m)


def test_an_observation_survives_with_its_nans() -> None:
    made = Observation(
        stamp_ns=7,
        pair_stamps_ns=(5, 7),
        metrics=(Metric("mi", 1 / 3, float("nan"), at_least=True),),
        offset=np.array([1 / 3, np.nan, 0.0, 1.0, 2.0, 3.0]),
        sigma=np.full(6, np.nan),
        distance2=1 / 7,
        flagged=True,
        weak=False,
        flagged_by_paper=None,
        causes=(CAUSES["dark"],),
        first_derivative=np.arange(6) / 7,
        second_derivative=np.arange(6) / 9,
        drift=Drift(np.arange(6) / 3, np.full(6, np.nan)),
        dirty=(3, 575),
        textured=400,
    )
    back = unpack_observation(msgpack.unpackb(msgpack.packb(pack_observation(made))))
    np.testing.assert_array_equal(back.offset, made.offset)
    np.testing.assert_array_equal(back.sigma, made.sigma)
    np.testing.assert_array_equal(back.first_derivative, made.first_derivative)
    np.testing.assert_array_equal(back.second_derivative, made.second_derivative)
    assert (back.dirty, back.textured) == ((3, 575), 400)
    assert back.drift is not None
    np.testing.assert_array_equal(back.drift.value, np.arange(6) / 3)
    assert np.isnan(back.drift.sigma).all()
    assert (back.stamp_ns, back.pair_stamps_ns, back.distance2, back.causes) == (7, (5, 7), 1 / 7, made.causes)
    assert (back.flagged, back.weak, back.flagged_by_paper) == (True, False, None)
    assert back.metrics[0].value == 1 / 3
    assert np.isnan(back.metrics[0].limit)
