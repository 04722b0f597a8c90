"""Clouds from hand-packed files: every layout, and every way in which one can lie."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import SourceError
from coec.io import user_files
from coec.io.recordings.cloud_files import PcdError, load_cloud, parse_pcd

NAN = float("nan")
POINTS = [(1.5, -2.0, 3.25, 10.0, 3), (NAN, 0.0, 0.0, 20.0, 4), (4.0, 5.0, -6.0, 30.5, 5)]


def header(fields: str, sizes: str, types: str, data: str, points: int = 3, width: int = 3, height: int = 1) -> str:
    counts = " ".join("1" for _ in fields.split())
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    )


XYZIR = ("x y z intensity ring", "4 4 4 4 1", "F F F F U")
ASCII = (header(*XYZIR, "ascii") + "".join(" ".join(map(str, p)) + "\n" for p in POINTS)).encode()
BINARY = header(*XYZIR, "binary").encode() + b"".join(struct.pack("<ffffB", *p) for p in POINTS)


def columns_of(points: list[tuple[float, float, float, float, int]]) -> bytes:
    floats = b"".join(struct.pack("<3f", *(p[i] for p in points)) for i in range(4))
    return floats + bytes(p[4] for p in points)


def lzf_literals(data: bytes) -> bytes:
    """LZF with literal runs only: a control byte of length - 1 before up to 32 bytes."""
    runs = [data[at : at + 32] for at in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def compressed(packed: bytes, size: int, points: int = 3) -> bytes:
    head = header(*XYZIR, "binary_compressed", points=points, width=points).encode()
    return head + struct.pack("<II", len(packed), size) + packed


COMPRESSED = compressed(lzf_literals(columns_of(POINTS)), 3 * 17)


@pytest.mark.parametrize("data", [ASCII, BINARY, COMPRESSED], ids=["ascii", "binary", "binary_compressed"])
def test_the_three_encodings_agree_and_nan_rows_go_with_their_columns(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(data)
    frame = load_cloud(5, "lidar", path)
    assert (frame.stamp_ns, frame.frame_id) == (5, "lidar")
    assert frame.xyz_m.dtype == np.float32
    assert frame.xyz_m.tolist() == [[1.5, -2.0, 3.25], [4.0, 5.0, -6.0]]
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [10.0, 30.5]
    assert frame.ring is not None
    assert frame.ring.dtype == np.uint16
    assert frame.ring.tolist() == [3, 5]
    assert frame.time_offset_s is None


def test_fields_in_any_order_with_padding_doubles_and_time() -> None:
    head = (
        "VERSION 0.7\nFIELDS t z _ y _ x\nSIZE 4 8 1 8 1 8\nTYPE U F U F U F\nCOUNT 1 1 3 1 2 1\n"
        "WIDTH 1\nHEIGHT 2\nPOINTS 2\nDATA binary\n"
    )
    rows = struct.pack("<Id3Bd2Bd", 50_000_000, 3.0, 9, 9, 9, 2.0, 9, 9, 1.0) * 2
    columns = parse_pcd(head.encode() + rows)
    assert columns["xyz"].tolist() == [[1.0, 2.0, 3.0]] * 2
    assert columns["time_offset_s"].tolist() == [np.float32(0.05)] * 2


def test_back_references_of_lzf() -> None:
    # 1 literal zero, then "copy 50 from 1 back" in the long form: 7 << 5, length - 9, distance - 1.
    packed = b"\x00\x00" + bytes([0xE0, 50 - 9, 0x00])
    columns = parse_pcd(compressed(packed, 51))
    assert columns["xyz"].tolist() == [[0.0] * 3] * 3
    # 4 literals "abcd", then 47 from 4 back: the pattern repeats.
    packed = b"\x03abcd" + bytes([0xE0, 47 - 9, 0x03])
    assert columns_of_bytes(parse_pcd(compressed(packed, 51)))[:8] == b"abcdabcd"


def columns_of_bytes(columns: dict[str, np.ndarray]) -> bytes:
    return np.ascontiguousarray(columns["xyz"][:, 0], dtype="<f4").tobytes()


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "line 1: the header ends without"),
        (b"\xff\xfe\n" * 3, "line 1: not a PCD"),
        (b"a" * 100_000, "line 1: the header ends"),
        (ASCII.replace(b"FIELDS x y z", b"FIELDS x y w"), "lacks z"),
        (ASCII.replace(b"SIZE 4 4 4 4 1", b"SIZE 4 4 4 4"), "SIZE"),
        (ASCII.replace(b"TYPE F", b"TYPE Q"), "unknown type Q4"),
        (ASCII.replace(b"COUNT 1 1", b"COUNT -1 1"), "COUNT"),
        (ASCII.replace(b"WIDTH 3", b"WIDTH 99999999999").replace(b"POINTS 3", b"POINTS 99999999999"), "too many"),
        (ASCII.replace(b"POINTS 3", b"POINTS 4"), "do not agree"),
        (ASCII.replace(b"DATA ascii", b"DATA zip"), "DATA must be"),
        (ASCII[: ASCII.rindex(b"4.0 5.0")], "line 13: the file ends after 2 of 3 points"),
        (ASCII.replace(b"5.0 -6.0", b"five -6.0"), "line 14: not a number"),
        (ASCII.replace(b"5.0 -6.0", b"-6.0"), "line 14: expected 5 numbers, found 4"),
        (ASCII.replace(b"30.5 5", b"30.5 300"), "line 14: a value does not fit its type uint8"),
        (ASCII.replace(b"30.5 5", b"30.5 nan"), "line 14: a value does not fit its type uint8"),
        (BINARY[:-1], "the file ends after 50 of 51 bytes"),
        (COMPRESSED[:-1], "compressed bytes"),
        (COMPRESSED[: COMPRESSED.index(b"compressed\n") + 14], "before the size"),
        (compressed(lzf_literals(columns_of(POINTS)), 2**31), "promised"),
        (compressed(b"\x1f" + bytes(10), 51), "a run passes the end"),
        (compressed(b"\x00\x00" + bytes([0xE0]), 51), "a reference is cut"),
        (compressed(b"\x00\x00" + bytes([0x20, 0x09]), 51), "before the start"),
        (compressed(b"\x00\x00" + bytes([0xE0, 255, 0]), 51), "more than the 51"),
        (compressed(b"\x00\x00", 51), "1 of 51 bytes"),
    ],
)
def test_a_pcd_that_lies_is_refused_with_its_place(tmp_path: Path, data: bytes, complaint: str) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=complaint) as caught:
        load_cloud(0, "lidar", path)
    assert str(path) in str(caught.value)


@given(st.sampled_from([ASCII, BINARY, COMPRESSED]), st.data())
def test_no_mutation_of_a_pcd_ends_otherwise_than_in_its_error(whole: bytes, data: st.DataObject) -> None:
    mutated = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3)) if mutated else 0):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        columns = parse_pcd(bytes(mutated))
    except PcdError:
        return
    assert columns["xyz"].shape[1] == 3


def test_velodyne_bin(tmp_path: Path) -> None:
    path = tmp_path / "scan.bin"
    path.write_bytes(struct.pack("<8f", 1, 2, 3, 0.5, NAN, 2, 3, 0.5) + struct.pack("<4f", 4, 5, 6, 0.25))
    frame = load_cloud(9, "velodyne", path)
    assert frame.xyz_m.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [0.5, 0.25]
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(SourceError, match="cut at byte 32"):
        load_cloud(9, "velodyne", path)
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="no finite point"):
        load_cloud(9, "velodyne", path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_npy(tmp_path: Path, dtype: type[np.floating]) -> None:
    path = tmp_path / "cloud.npy"
    np.save(path, np.array([[1, 2, 3, 7], [np.inf, 2, 3, 8]], dtype=dtype))
    frame = load_cloud(0, "lidar", path)
    assert frame.xyz_m.tolist() == [[1, 2, 3]]
    assert frame.intensity is not None
    assert frame.intensity.dtype == np.float32
    assert frame.intensity.tolist() == [7]
    np.save(path, np.zeros((5, 3), dtype))
    assert load_cloud(0, "lidar", path).intensity is None


def test_npz(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npz"
    xyz = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.float64)
    np.savez(path, xyz=xyz, ring=np.array([1, 2, 3], np.int64), time_offset_s=np.array([0.0, np.nan, 0.1]))
    frame = load_cloud(0, "lidar", path)
    assert frame.xyz_m.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert frame.ring is not None
    assert frame.ring.tolist() == [1, 3]
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.tolist() == [0.0, np.float32(0.1)]
    np.savez(path, xyz=xyz, ring=np.array([1, 2], np.int64))
    with pytest.raises(SourceError, match="`ring` has shape"):
        load_cloud(0, "lidar", path)
    np.savez(path, points=xyz)
    with pytest.raises(SourceError, match="array `xyz`"):
        load_cloud(0, "lidar", path)


def test_numpy_files_that_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cloud.npy"
    np.save(path, np.zeros((4, 3)))
    whole = path.read_bytes()
    # The header promises 9 terabytes: refused by the length of the file, not by the allocator.
    path.write_bytes(whole.replace(b"(4, 3), }" + b" " * 11, b"(400000000000, 3), }"))
    with pytest.raises(SourceError, match="truncated"):
        load_cloud(0, "lidar", path)
    path.write_bytes(whole[:-8])
    with pytest.raises(SourceError, match="truncated"):
        load_cloud(0, "lidar", path)
    np.save(path, np.array([{"a": 1}], dtype=object))
    with pytest.raises(SourceError, match="not a NumPy array"):
        load_cloud(0, "lidar", path)
    np.save(path, np.zeros((4, 3), np.int32))
    with pytest.raises(SourceError, match="expected float"):
        load_cloud(0, "lidar", path)
    packed = tmp_path / "cloud.npz"
    packed.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(SourceError, match="is not an"):
        load_cloud(0, "lidar", packed)
    np.savez_compressed(packed, xyz=np.zeros((6_000, 3)))
    monkeypatch.setattr(user_files, "MAX_FILE_BYTES", 100_000)
    with pytest.raises(SourceError, match="would unpack"):
        load_cloud(0, "lidar", packed)


def test_unknown_suffix_and_absent_file(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="clouds are"):
        load_cloud(0, "lidar", tmp_path / "cloud.ply")
    with pytest.raises(SourceError, match="does not exist"):
        load_cloud(0, "lidar", tmp_path / "cloud.pcd")


def test_the_garage_clouds(sample_data: Path) -> None:
    frame = load_cloud(0, "lidar", sample_data / "fisheye_garage" / "pcd" / "pose1.pcd")
    assert frame.xyz_m.shape == (65536, 3)
    assert frame.xyz_m[0].tolist() == [np.float32(-4.825851), np.float32(0.11671495), np.float32(1.8898743)]
    assert frame.intensity is not None
    assert frame.intensity[0] == 138
