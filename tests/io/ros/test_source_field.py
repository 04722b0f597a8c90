"""Clouds of several LiDARs in one message, split by the field that tells them apart; packed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.ros.message_decoding import decode
from coec.io.ros.messages import POINT_CLOUD
from support.ros import CODES, cloud

COUNT = 6
X = np.arange(1.0, COUNT + 1)
SOURCES = [0, 2, 2, 0, 7, 2]


def a_cloud(name: str = "lidar_id", form: str = "u1", sources: list[int] = SOURCES, **rows: int) -> bytes:
    """Points of 20 bytes: x, y, z, the source, then a ring, with padding between; in `rows`, if not in one."""
    point = np.dtype(
        {
            "names": ["x", "y", "z", "source", "ring"],
            "formats": ["<f4", "<f4", "<f4", form, "<u2"],
            "offsets": [0, 4, 8, 12, 16],
            "itemsize": 20,
        }
    )
    points = np.zeros(COUNT, point)
    points["x"], points["z"], points["source"], points["ring"] = X, 1.0, sources, X
    fields = [(axis, 4 * i, CODES["<f4"]) for i, axis in enumerate("xyz")]
    fields += [(name, 12, CODES[form]), ("ring", 16, CODES["<u2"])]
    height = rows.get("height", 1)
    gap = bytes(rows.get("gap", 0))
    data = b"".join(row.tobytes() + gap for row in points.reshape(height, -1))
    width = COUNT // height
    return cloud(fields, data, width, 20, height=height, row_step=width * 20 + len(gap))


def taken(message: bytes, source: int | None) -> LidarFrame:
    frame = decode(POINT_CLOUD, message, LimitsConfig(), source=source)
    assert isinstance(frame, LidarFrame)
    return frame


@pytest.mark.parametrize("name", ["lidar_id", "sensor_id", "source_id", "device_id", "source"])
@pytest.mark.parametrize("form", ["u1", "<u2", "<i4"])
def test_the_points_of_one_lidar_are_taken_in_their_order(name: str, form: str) -> None:
    frame = taken(a_cloud(name, form), 2)
    assert frame.xyz_m[:, 0].tolist() == [2, 3, 6]
    assert frame.ring is not None
    assert frame.ring.tolist() == [2, 3, 6]


@pytest.mark.parametrize(("height", "gap"), [(2, 0), (3, 4)])
def test_a_cloud_of_rows_is_split_too(height: int, gap: int) -> None:
    assert taken(a_cloud(height=height, gap=gap), 0).xyz_m[:, 0].tolist() == [1, 4]


@pytest.mark.fault("a cloud of several LiDARs", "refused as `cloud_concatenated`, and its sources are listed")
@pytest.mark.parametrize(("source", "reported"), [(None, "0, 2, 7; choose one"), (5, "0, 2, 7; none has 5")])
def test_several_sources_are_refused_unless_one_of_them_is_selected(source: int | None, reported: str) -> None:
    with pytest.raises(DecodeError, match=f"concatenated: its lidar_id has {reported}") as refused:
        taken(a_cloud(), source)
    assert refused.value.reason == "cloud_concatenated"


def test_a_source_that_no_field_reports_is_refused() -> None:
    with pytest.raises(DecodeError, match="no field of the points names one"):
        taken(a_cloud("laser_id"), 2)


@pytest.mark.parametrize(("name", "sources"), [("lidar_id", [3] * COUNT), ("laser_id", SOURCES)])
def test_a_cloud_of_one_lidar_is_taken_as_it_is(name: str, sources: list[int]) -> None:
    assert taken(a_cloud(name, sources=sources), None).xyz_m[:, 0].tolist() == X.tolist()


def test_the_list_of_sources_is_short_whatever_the_field_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coec.io.ros.point_clouds.MAX_LISTED", 2)
    with pytest.raises(DecodeError, match=r"has 0, 2, \.\.\.;"):
        taken(a_cloud(), None)
