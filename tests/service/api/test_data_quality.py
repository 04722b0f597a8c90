"""What health says of the streams: how points are timed, and what motion compensation lacks."""

from dataclasses import replace

import pytest

from coec.config import IDENTITY, CameraConfig, CameraIntrinsics, EgoConfig, LidarConfig, PairConfig
from coec.service.api.reply_builders import data_quality_of, needs_of
from coec.service.ingest.decoder import EGO, StreamCounts
from coec.service.ingest.pair_stream import StreamStatistics
from support.estimates import estimate

PAIR = PairConfig(
    name="front",
    camera=CameraConfig(
        key="c", intrinsics=CameraIntrinsics(model="pinhole", width=4, height=3, fx=1, fy=1, cx=1, cy=1)
    ),
    lidar=LidarConfig(key="l"),
    ego=EgoConfig(key="e"),
    T_camera_lidar=IDENTITY,
)
LINE = "t: uint32, ns since the stamp; 0.0 to 99.9 ms, stamped at its begin"


def test_how_points_are_timed_is_reported() -> None:
    assert data_quality_of(StreamStatistics(timed_by=LINE), {}).point_times == LINE


@pytest.mark.parametrize(
    ("compensation", "need"),
    [
        ({"done": 3, "rotation_only": 0}, None),
        ({"done": 1, "rotation_only": 2}, "no linear velocity: rotation is compensated, translation is not"),
        ({"done": 1, "no_point_time": 2}, "motion compensation has no point times"),
    ],
)
def test_what_motion_compensation_lacks_is_needed(compensation: dict[str, int], need: str | None) -> None:
    report = StreamStatistics(streams={EGO: StreamCounts(3, 3)}, pairs=3)

    needs = needs_of(report, PAIR, replace(estimate(1), compensation=compensation))

    reported = [one for one in needs if one.startswith("motion compensation")]
    assert (need is None) == (not reported)
    assert need is None or need in reported[0]
