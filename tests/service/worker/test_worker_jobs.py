"""The frames of a check on their way to the worker: nothing is lost, to the bit."""

import msgpack
import numpy as np

from coec.calibration.frames.pairing import Pairer
from coec.config import LimitsConfig, PairingConfig
from coec.service.worker.worker_jobs import pack_pairs, unpack_pairs
from support.simulated_drives import rendered_source


def test_pairs_survive() -> None:
    pairer = Pairer(PairingConfig(), expects_motion=True)
    recording = rendered_source("sim:seconds=2&camera_hz=1&lidar_hz=1&camera=fisheye64&lidar=16&depth=yes")
    pairs = [pair for message in recording.messages() for pair in pairer.push(message)]
    pairs += pairer.flush()
    back = unpack_pairs(msgpack.unpackb(msgpack.packb([*pack_pairs(pairs)]), max_bin_len=2**30), LimitsConfig())
    assert len(back) == 2
    for one, other in zip(pairs, back, strict=True):
        assert one.camera == other.camera
        assert one.motion == other.motion
        np.testing.assert_array_equal(one.lidar.xyz_m, other.lidar.xyz_m)
