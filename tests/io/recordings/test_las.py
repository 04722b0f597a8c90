"""Clouds from LAS files: packed by hand after the specification, and written by `laspy`."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.errors import SourceError
from coec.io.recordings.cloud_files import load_cloud

POINTS = [(100, 2000, -300, 7), (-500, 25, 1000, 65535), (0, 0, 1, 0)]
STAMP_NS = 1_700_000_000 * 10**9


def las(form: int = 1, minor: int = 2, *, count: int | None = None, more: int = 0, times: bool = True) -> bytes:
    """A file of `POINTS` in centimetres, 10 m off in x."""
    least = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)[form & 0x7F]
    header_bytes = 375 if minor == 4 else 227
    number = len(POINTS) if count is None else count
    legacy = 0 if minor == 4 else number
    data = struct.pack(
        "<4s20xBB68xHIIBHI20x", b"LASF", 1, minor, header_bytes, header_bytes, 0, form, least + more, legacy
    )
    data += struct.pack("<6d", 0.01, 0.01, 0.01, 10.0, 0.0, 0.0) + bytes(48)
    data = data.ljust(247, b"\0")[:header_bytes]
    if minor == 4:
        data += struct.pack("<Q", number)
    data = data.ljust(header_bytes, b"\0")
    at = {1: 20, 3: 20, 4: 20, 5: 20}.get(form, 22 if form >= 6 else None)
    for place, (x, y, z, intensity) in enumerate(POINTS):
        row = bytearray(struct.pack("<iiiH", x, y, z, intensity).ljust(least + more, b"\0"))
        if at is not None and times:
            row[at : at + 8] = struct.pack("<d", STAMP_NS * 1e-9 + 0.04 * place)
        data += row
    return data


def loaded(folder: Path, data: bytes) -> Any:
    path = folder / "cloud.las"
    path.write_bytes(data)
    return load_cloud(STAMP_NS, "lidar", path)


@pytest.mark.parametrize("form", range(11))
@pytest.mark.parametrize("more", [0, 3])
def test_every_point_format(tmp_path: Path, form: int, more: int) -> None:
    sweep = loaded(tmp_path, las(form, 4 if form >= 6 else 2, more=more))
    assert sweep.xyz_m == pytest.approx(np.array([[11, 20, -3], [5, 0.25, 10], [10, 0, 0.01]]), abs=1e-5)
    assert sweep.intensity.tolist() == [7, 65535, 0]
    if form in (0, 2):
        assert sweep.time_offset_s is None
    else:
        np.testing.assert_allclose(sweep.time_offset_s, [0.0, 0.04, 0.08], atol=1e-6)
    assert loaded(tmp_path, las(form, 4 if form >= 6 else 2, times=False)).time_offset_s is None


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", "no header of a LAS file"),
        (b"LASX" + las()[4:], "no header of a LAS file"),
        (las()[:200], "3 points of 28 bytes are cut off after 200 bytes"),
        (las()[:-1], "are cut off"),
        (las(count=0), "it has 0 points"),
        (las(count=2**31), "it has 2147483648 points"),
        (las(6, 4, count=2**62), "it has 4611686018427387904 points"),
        (las(1)[:104] + bytes([0x81]) + las(1)[105:], "it is LAZ: unpack it with `laszip"),
        (las(1)[:104] + bytes([11]) + las(1)[105:], "points of type 11 is not read"),
        (las(1)[:104] + bytes([5]) + las(1)[105:], "points of type 5 is not read"),
        (las(1)[:24] + b"\2" + las(1)[25:], "version 2.2"),
    ],
)
def test_what_is_no_sound_file_is_refused_with_its_place(tmp_path: Path, data: bytes, cause: str) -> None:
    with pytest.raises(SourceError, match=f"cloud.las, byte .*{cause}"):
        loaded(tmp_path, data)


@pytest.mark.parametrize(("version", "form"), [("1.2", 3), ("1.4", 6)])
def test_a_file_that_laspy_writes(tmp_path: Path, version: str, form: int) -> None:
    laspy = pytest.importorskip("laspy", reason="needs laspy")
    header = laspy.LasHeader(version=version, point_format=form)
    header.scales, header.offsets = [0.001] * 3, [0.0] * 3
    xyz_m: Any = np.random.default_rng(0).uniform(-50, 50, (500, 3))
    file = laspy.LasData(header)
    file.x, file.y, file.z = xyz_m.T
    file.intensity = np.arange(500)
    file.gps_time = STAMP_NS * 1e-9 + np.arange(500) * 2e-4
    file.write(tmp_path / "cloud.las")
    sweep = loaded(tmp_path, (tmp_path / "cloud.las").read_bytes())
    np.testing.assert_allclose(sweep.xyz_m, xyz_m, atol=1e-3)
    assert sweep.intensity is not None
    assert sweep.intensity.tolist() == list(range(500))
    np.testing.assert_allclose(sweep.time_offset_s, np.arange(500) * 2e-4, atol=1e-6)
