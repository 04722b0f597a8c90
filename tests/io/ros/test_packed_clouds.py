"""Packed clouds in messages: of point_cloud_transport (Draco, Cloudini, zlib, zstd) and for Foxglove (Draco). Each is
packed by the library that packs such clouds."""

from __future__ import annotations

import base64
import importlib.util
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError, SourceError
from coec.io.recordings.layouts import open_source
from coec.io.ros import messages
from coec.io.ros.message_decoding import decode
from support.encodings import (
    of_cloudini,
    of_draco,
    of_zlib,
    of_zstd,
    packed_cloud_of,
    packed_message,
)
from support.recordings import Bag, drive_messages
from support.ros import STAMP_NS, Packer

LIMITS = LimitsConfig()
COUNT = 500

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")])
"""Without padding: 22 bytes."""

FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("t", 18, 6)]


def points() -> NDArray[Any]:
    rng, rows = np.random.default_rng(0), np.zeros(COUNT, POINT)
    for axis in "xyz":
        rows[axis] = rng.uniform(-40.0, 40.0, COUNT)
    rows["intensity"], rows["ring"] = rng.integers(0, 255, COUNT), np.arange(COUNT) % 16
    rows["t"] = np.arange(COUNT) * 200_000
    return rows


def message(form: str, packed: bytes, *, width: int = COUNT, fields: Any = FIELDS) -> bytes:
    return packed_message(Packer().header("lidar"), form, packed, width, POINT.itemsize, fields)


def sweep_of(payload: bytes, type_name: str = messages.COMPRESSED_CLOUD) -> LidarFrame:
    frame = decode(type_name, payload, LIMITS)
    assert isinstance(frame, LidarFrame)
    return frame


def require_points(sweep: LidarFrame, rows: NDArray[Any], tolerance_m: float = 0.0) -> None:
    assert (sweep.stamp_ns, sweep.frame_id) == (STAMP_NS, "lidar")
    expected = np.stack([rows[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(sweep.xyz_m, expected, atol=tolerance_m, rtol=0.0)
    assert sweep.ring is not None
    assert sweep.intensity is not None
    assert sweep.time_offset_s is not None
    np.testing.assert_array_equal(sweep.ring, rows["ring"])
    np.testing.assert_array_equal(sweep.intensity, rows["intensity"])
    np.testing.assert_allclose(sweep.time_offset_s, rows["t"] * 1e-9, atol=1e-7)


@pytest.mark.parametrize(("form", "pack"), [("zlib", of_zlib), ("zstd", of_zstd), ("cloudini", of_cloudini)])
def test_a_lossless_form_gives_the_same_points(form: str, pack: Callable[[NDArray[Any]], bytes]) -> None:
    require_points(sweep_of(message(form, pack(points()))), points())


@pytest.mark.parametrize("version", [2, 3, 4, 5])
def test_each_version_of_cloudini(version: int) -> None:
    require_points(sweep_of(message("cloudini", of_cloudini(points(), version=version))), points())


def test_draco_gives_the_points_to_its_quantisation() -> None:
    require_points(sweep_of(message("draco", of_draco(points()))), points(), 80.0 / 2**20)


def test_draco_in_an_order_of_its_own_keeps_the_columns_together() -> None:
    sweep, rows = sweep_of(message("draco", of_draco(points(), kd_tree=True))), points()
    assert sweep.ring is not None
    at = np.argmin(np.linalg.norm(sweep.xyz_m[:, None] - np.stack([rows[a] for a in "xyz"], 1)[None], axis=2), axis=1)
    assert len(np.unique(at)) == COUNT
    np.testing.assert_array_equal(sweep.ring, rows["ring"][at])


def test_foxgloves_form_of_draco() -> None:
    packed = of_draco(points())
    for place in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)):
        packer = Packer().header("lidar").put("d", *place, 0.0, 0.0, 0.0, 1.0).octets(packed).text("draco")
        if any(place):
            with pytest.raises(DecodeError, match="has a pose in its frame"):
                sweep_of(packer.done(), messages.FOXGLOVE_CLOUD)
        else:
            require_points(sweep_of(packer.done(), messages.FOXGLOVE_CLOUD), points(), 80.0 / 2**20)


def draco_bytes(place: int, value: bytes) -> bytes:
    packed = bytearray(of_draco(points()))
    packed[place : place + len(value)] = value
    return bytes(packed)


@pytest.mark.parametrize(
    ("payload", "cause"),
    [
        (lambda: message("zlib", b"abc"), "not packed by zlib"),
        (lambda: message("zlib", of_zlib(points())[:-40]), "fit|cut|bytes"),
        (lambda: message("zlib", zlib.compress(bytes(10**7)), width=0), "no point|has no|empty"),
        (lambda: message("zlib", of_zlib(points()), width=2**31), "would unpack to 47244640256 bytes"),
        (lambda: message("zstd", b"abc"), "not packed by zstd"),
        (lambda: message("zstd", zstandard.compress(bytes(10**7))), "more than its 11000 bytes"),
        (lambda: message("lz4", b"abc"), "of the format 'lz4': draco, zlib, zstd, cloudini are read"),
        (lambda: message("cloudini", b"CLOUDINI_V03\nwidth: 1\n"), "not packed by Cloudini"),
        (lambda: message("cloudini", of_cloudini(points()), width=10), "more than its 220 bytes"),
        (lambda: message("cloudini", of_cloudini(points())[:-50]), "by Cloudini is damaged"),
        (lambda: message("draco", b"DRACO\2\3\1\0\0\0abc"), "it is a mesh"),
        (lambda: message("draco", of_draco(points())[:30]), "cut off"),
        (lambda: message("draco", of_draco(points())[:300]), "by Draco is damaged"),
        (lambda: message("draco", of_draco(points()), width=400), "has 500 points; its message allows 400"),
        (lambda: message("draco", of_draco(points()), fields=[*FIELDS[:-1], ("t", 20, 6)]), "outside of the 22 bytes"),
        (lambda: message("draco", of_draco(points()), fields=[*FIELDS, ("u", 18, 6)]), "points and fields"),
    ],
)
def test_what_is_no_packed_cloud_is_refused(payload: Callable[[], bytes], cause: str) -> None:
    with pytest.raises(DecodeError, match=cause):
        sweep_of(payload())


@pytest.mark.fault("a cloud packed by Draco that promises billions of points", "nothing is allocated for it")
def test_a_draco_cloud_that_promises_more_than_its_message_is_refused() -> None:
    pytest.importorskip("DracoPy", reason="needs the extra draco")
    head = b"DRACO" + struct.pack("<BBBBH", 2, 3, 0, 0, 0)
    for body in (struct.pack("<IBB", 2**32 - 1, 1, 1), struct.pack("<IB", COUNT, 1) + b"\xff\xff\xff\xff\x0f"):
        with pytest.raises(DecodeError, match=r"its message allows|more attributes"):
            sweep_of(message("draco", head + body + b"\0\x09\xff\0\0" * 3))


@given(st.integers(0, 400), st.binary(min_size=1, max_size=8), st.sampled_from(["draco", "cloudini", "zlib", "zstd"]))
def test_damaged_bytes_raise_nothing_else(place: int, value: bytes, form: str) -> None:
    packed = bytearray({"draco": of_draco, "cloudini": of_cloudini, "zlib": of_zlib, "zstd": of_zstd}[form](points()))
    packed[place : place + len(value)] = value
    try:
        sweep_of(message(form, bytes(packed)))
    except DecodeError:
        return


def bag_of_packed(folder: Path, form: str, pack: Callable[[NDArray[Any]], bytes]) -> str:
    """The drive, its clouds packed."""
    folder.mkdir()
    drive = drive_messages()
    Bag([(topic, one) for topic, one in drive if topic != "/points"]).write(folder / "drive.mcap")
    with (folder / "packed.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(messages.COMPRESSED_CLOUD, "ros2msg", b"")
        channel = writer.register_channel("/points/packed", "cdr", schema)
        for time, (topic, one) in enumerate(drive):
            if topic == "/points":
                writer.add_message(channel, time, packed_cloud_of(one, form, pack), time)
        writer.finish()  # type: ignore[no-untyped-call]
    return str(folder)


@pytest.mark.parametrize(("form", "pack"), [("zlib", of_zlib), ("zstd", of_zstd)])
def test_a_bag_of_packed_clouds_is_the_same_recording(
    tmp_path: Path, form: str, pack: Callable[[NDArray[Any]], bytes]
) -> None:
    native = open_source(str(Bag(drive_messages()).write(tmp_path / "native.mcap")))
    packed = open_source(bag_of_packed(tmp_path / "bag", form, pack))
    expected, result = (
        [one.xyz_m for one in recording.messages() if isinstance(one, LidarFrame)] for recording in (native, packed)
    )
    assert len(result) == len(expected) > 0
    for a, b in zip(result, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = of_draco(points()[:4])
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(SourceError, match=r"pip install 'coec\[draco\]'; or unpack them with `ros2 run"):
        open_source(bag_of_packed(tmp_path / "bag", "draco", lambda _: packed))


# --- the layout of draco_point_cloud_transport ------------------------------------------------------------------------

KD_TREE = (
    "RFJBQ08CAwABAIAAAQtkZWR1cGxpY2F0ZQQBAAAAAAgAAAABBgAJAQAAAAkBAAEACQEAAgQJAQADBAQBAAQEBgEABQMbAAAACAAA"
    "AGwI2Go64/5QGoGUAAAA4P8HAAD4/wEfAAAAAACA/wDsYGEAbNsAJABs22zbAJBOCgAASQAAHCRJACQA2jYAAAAkSQC0xAAAti0A"
    "EgC2LbYtAEn6AQAACQCA8CQJgCQA2xaAAIAkCYCWGAFA2wYACUDbBtsGgCTyAABAAADgcAAAAADg/wcAAAAAAAAAAABAkgAAA0CS"
    "AJIAsG0ZAABAAABoiQQAAAAAAAAABAAAAAAAAAAAAIA/AADgQA4AAAAAAABgQQ4AAOC/AADgPw4AAAAAAABEQg4="
)
"""Eight points by the C++ library of Draco 1.5.7 as `convertPC2toDraco` calls it: an attribute of one component a
field, x, y and z each a POSITION; the k-d tree and 14 bits."""

SEQUENTIAL = (
    "RFJBQ08CAwAAAIAAAQtkZWR1cGxpY2F0ZQQBAAAAAAgAAAABBgAJAQAAAAkBAAEACQEAAgQJAQADBAQBAAQEBgEABQAAAAABAQAA"
    "gD8AAABAAABAQAAAgEAAAKBAAADAQAAA4EAAAABBAAAAAAAAAEAAAIBAAADAQAAAAEEAACBBAABAQQAAYEEAAAAAAACAvgAAAL8A"
    "AEC/AACAvwAAoL8AAMC/AADgvwAAAAAAAOBAAABgQQAAqEEAAOBBAAAMQgAAKEIAAERCAAEBAQEDAQgDATgDAFCFAAAAAAMAAAAA"
    "AQEAGgMBCFsBOAMAUIUAWmICtMQEaIkJ0BIToCUmQEtMgJaYAAAAAIAdLAQ="
)
"""The same without quantisation."""


@pytest.mark.parametrize(("packed", "share"), [(KD_TREE, 2**-13), (SEQUENTIAL, 0.0)])
def test_draco_as_ros_packs_it(packed: str, share: float) -> None:
    pytest.importorskip("DracoPy", reason="needs the extra draco")
    sweep, index = sweep_of(message("draco", base64.b64decode(packed), width=8)), np.arange(8)
    expected = np.stack([index + 1.0, 2.0 * index, -0.25 * index], axis=1)
    order = np.argsort(sweep.xyz_m[:, 0])
    np.testing.assert_allclose(sweep.xyz_m[order], expected, atol=14.0 * share)
    assert sweep.ring is not None
    assert sweep.time_offset_s is not None
    np.testing.assert_array_equal(sweep.ring[order], index % 4)
    np.testing.assert_allclose(sweep.time_offset_s[order], 0.01 * index, atol=0.07 * share + 1e-9)
