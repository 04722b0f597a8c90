"""Clouds from hand-packed files: every layout, and every way in which one can lie."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import SourceError
from coec.io import user_files
from coec.io.recordings.cloud_files import CloudLayout, load_cloud
from coec.io.recordings.cloud_formats import Table, TableError, parse_pcd, parse_ply

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


def test_fields_in_any_order_with_padding_doubles_and_time(tmp_path: Path) -> None:
    head = (
        "VERSION 0.7\nFIELDS t z _ y _ x\nSIZE 4 8 1 8 1 8\nTYPE U F U F U F\nCOUNT 1 1 3 1 2 1\n"
        "WIDTH 1\nHEIGHT 2\nPOINTS 2\nDATA binary\n"
    )
    rows = struct.pack("<Id3Bd2Bd", 50_000_000, 3.0, 9, 9, 9, 2.0, 9, 9, 1.0) * 2
    path = tmp_path / "cloud.pcd"
    path.write_bytes(head.encode() + rows)
    frame = load_cloud(0, "lidar", path)
    assert frame.xyz_m.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.tolist() == [np.float32(0.05)] * 2


def test_back_references_of_lzf() -> None:
    # 1 literal zero, then "copy 50 from 1 back" in the long form: 7 << 5, length - 9, distance - 1.
    packed = b"\x00\x00" + bytes([0xE0, 50 - 9, 0x00])
    table = parse_pcd(compressed(packed, 51))
    assert [table[axis].tolist() for axis in "xyz"] == [[0.0] * 3] * 3
    # 4 literals "abcd", then 47 from 4 back: the pattern repeats.
    packed = b"\x03abcd" + bytes([0xE0, 47 - 9, 0x03])
    assert columns_of_bytes(parse_pcd(compressed(packed, 51)))[:8] == b"abcdabcd"


def columns_of_bytes(table: Table) -> bytes:
    return np.ascontiguousarray(table["x"], dtype="<f4").tobytes()


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
        table = parse_pcd(bytes(mutated))
    except TableError:
        return
    assert {"x", "y", "z"} <= set(table.dtype.names or ())


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


@pytest.mark.parametrize(("ring", "expected"), [(2.0, [1, 2]), (np.inf, None), (np.nan, None), (0.5, None)])
def test_numbers_of_rings_as_floats_are_whole_where_points_are_finite(
    tmp_path: Path, ring: float, expected: list[int] | None
) -> None:
    path = tmp_path / "cloud.pcd"
    rows = np.array([[1, 2, 3, 1], [4, 5, 6, ring], [np.nan, 0, 0, np.nan]], "<f4")
    header = "FIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n"
    path.write_bytes(b"VERSION .7\n" + header.encode() + rows.tobytes())
    read = load_cloud(0, "lidar", path).ring
    assert (None if read is None else read.tolist()) == expected


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
        load_cloud(0, "lidar", tmp_path / "cloud.xyz")
    with pytest.raises(SourceError, match="does not exist"):
        load_cloud(0, "lidar", tmp_path / "cloud.pcd")


def test_the_garage_clouds(sample_data: Path) -> None:
    frame = load_cloud(0, "lidar", sample_data / "fisheye_garage" / "pcd" / "pose1.pcd")
    assert frame.xyz_m.shape == (65536, 3)
    assert frame.xyz_m[0].tolist() == [np.float32(-4.825851), np.float32(0.11671495), np.float32(1.8898743)]
    assert frame.intensity is not None
    assert frame.intensity[0] == 138


# --- layouts that a file does not state -------------------------------------------------------------------------------


def a_sweep(columns: int) -> np.ndarray:
    """(N, columns) float32 of a turning LiDAR in a street: x y z intensity ring time, in the order of its firing."""
    rng = np.random.default_rng(7)
    azimuth, beam = np.repeat(np.linspace(-np.pi, np.pi, 300), 16), np.tile(np.arange(16), 300)
    elevation = np.radians(2.0 * beam - 15.0)
    reach = np.minimum(np.minimum(60.0, 6.0 / np.abs(np.sin(azimuth))), np.abs(1.8 / np.sin(elevation)))
    xyz = reach * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    further = [rng.uniform(0, 255, azimuth.size), beam, (azimuth + np.pi) * 0.1 / (2 * np.pi)]
    return np.column_stack([*xyz, *further])[:, :columns].astype("<f4")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize("times", [1, 25])
def test_the_columns_of_a_bin_are_recognised_by_their_values(tmp_path: Path, columns: int, times: int) -> None:
    # 4800 points or 120,000: 3, 4, 5 and 6 columns fit the size of each of these files.
    path = tmp_path / "cloud.bin"
    points = np.tile(a_sweep(columns), (times, 1))
    points.tofile(path)
    frame = load_cloud(0, "lidar", path)
    assert np.array_equal(frame.xyz_m, points[:, :3])
    assert (frame.intensity is None) == (columns < 4)
    assert (frame.ring is None) == (columns < 5)
    assert frame.ring is None or np.array_equal(frame.ring, points[:, 4])
    assert frame.time_offset_s is None


def test_columns_that_are_named_count_and_their_times_are_recognised(tmp_path: Path) -> None:
    path = tmp_path / "cloud.bin"
    points = a_sweep(6)
    points.tofile(path)
    frame = load_cloud(0, "lidar", path, CloudLayout(("x", "y", "z", "_", "ring", "time")))
    assert frame.intensity is None
    assert frame.time_offset_s is not None
    assert np.array_equal(frame.time_offset_s, points[:, 5])
    assert frame.timed_by.startswith("time: float32, s since the stamp")
    assert frame.recognitions == ()
    (recognition,) = load_cloud(0, "lidar", path).recognitions
    assert "read as x y z intensity ring _" in recognition.text


def test_a_bin_that_two_numbers_of_columns_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cloud.bin"
    np.abs(a_sweep(6)).tofile(path)
    with pytest.raises(SourceError, match="may hold 4 or 6 float32 a point"):
        load_cloud(0, "lidar", path)


@pytest.mark.parametrize("dtype", ["<f8", "<i4"])
def test_a_bin_of_other_numbers_than_float32_is_refused(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "cloud.bin"
    (1000 * a_sweep(4)).astype(dtype).tofile(path)
    with pytest.raises(SourceError, match="no table of 3 to 6 float32"):
        load_cloud(0, "lidar", path)


def test_further_columns_of_an_npy(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    points = a_sweep(6).astype(np.float64)
    np.save(path, points)
    frame = load_cloud(0, "lidar", path)
    assert frame.ring is not None
    assert np.array_equal(frame.ring, points[:, 4])
    colour = np.random.default_rng(1).integers(0, 256, (len(points), 3))
    np.save(path, np.column_stack([points[:, :3], colour]))
    frame = load_cloud(0, "lidar", path)
    assert (frame.intensity, frame.ring) == (None, None)
    fields = np.zeros(2, [("x", "f4"), ("y", "f4"), ("z", "f8"), ("Intensity", "u1"), ("list", "f4", (3,))])
    fields["x"], fields["Intensity"] = 1.0, 200
    np.save(path, fields)
    frame = load_cloud(0, "lidar", path)
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [200.0, 200.0]


STAMP_NS = 1_600_000_000_100_000_000


@pytest.mark.parametrize(
    ("name", "code", "times"),
    [
        ("timestamp", "F8", STAMP_NS * 1e-9 + np.array([-0.05, 0.0, 0.05])),
        ("time", "F8", STAMP_NS * 1e-9 + np.array([-0.05, 0.0, 0.05])),
        ("t", "U4", np.array([0, 50_000, 100_000])),
        ("offset_time", "U4", np.array([0, 50_000_000, 100_000_000])),
        ("time", "F4", np.array([-0.05, 0.0, 0.05])),
    ],
    ids=["Hesai and RoboSense", "absolute", "µs", "Livox", "Velodyne"],
)
def test_times_of_a_pcd_are_recognised_as_in_messages(tmp_path: Path, name: str, code: str, times: np.ndarray) -> None:
    kind, size = code[0], code[1]
    rows = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, f"<{kind.lower()}{size}")])
    rows[name], rows["x"] = times, 5.0
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header(f"x y z {name}", f"4 4 4 {size}", f"F F F {kind}", "binary").encode() + rows.tobytes())
    frame = load_cloud(STAMP_NS, "lidar", path)
    assert frame.time_offset_s is not None
    assert np.ptp(frame.time_offset_s) == pytest.approx(0.1, abs=1e-6)
    assert frame.timed_by.startswith(name)


def test_times_on_a_clock_that_the_stamp_does_not_share_are_left_out(tmp_path: Path) -> None:
    rows = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
    rows["timestamp"], rows["x"] = STAMP_NS * 1e-9, 5.0
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header("x y z timestamp", "4 4 4 8", "F F F F", "binary").encode() + rows.tobytes())
    frame = load_cloud(0, "lidar", path)
    assert frame.time_offset_s is None
    assert "not near the stamp" in frame.timed_by


def test_fields_of_no_count_take_no_bytes() -> None:
    """As in a PCD that an Ouster driver's points were stored to (PDAL, issue 3254)."""
    head = (
        "VERSION 0.7\nFIELDS x y z _ intensity t reflectivity ring _ noise _ range _\n"
        "SIZE 4 4 4 1 4 4 2 1 1 2 1 4 1\nTYPE F F F U F U U U U U U U U\nCOUNT 1 1 1 4 1 1 1 1 0 1 0 1 15\n"
        "WIDTH 1\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA binary\n"
    )
    row = struct.pack("<3f4xfIHBHI15x", 1.0, 2.0, 3.0, 4.0, 5, 6, 7, 8, 9)
    table = parse_pcd(head.encode() + row)
    assert [table[name].tolist() for name in ("z", "intensity", "ring", "range")] == [[3.0], [4.0], [7], [9]]


def ply(form: str, body: bytes, count: int = 2) -> bytes:
    head = (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\nproperty float x\nproperty float y\n"
        "property double z\nproperty uchar scalar_Intensity\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + body


PLY = {
    "ascii": b"1 2 3 4\n5 6 7 8\n3 0 1 1\n",
    "binary_little_endian": struct.pack("<ffdB", 1, 2, 3, 4) + struct.pack("<ffdB", 5, 6, 7, 8) + bytes(13),
    "binary_big_endian": struct.pack(">ffdB", 1, 2, 3, 4) + struct.pack(">ffdB", 5, 6, 7, 8) + bytes(13),
}


@pytest.mark.parametrize("form", PLY)
def test_the_vertices_of_a_ply(tmp_path: Path, form: str) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply(form, PLY[form]))
    frame = load_cloud(0, "lidar", path)
    assert frame.xyz_m.tolist() == [[1, 2, 3], [5, 6, 7]]
    assert frame.intensity is not None
    assert frame.intensity.tolist() == [4, 8]


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "not a PLY"),
        (ply("binary_little_endian", bytes(33)), "ends after 33 of 34 bytes"),
        (ply("ascii", b"1 2 3 4\n"), "ends after 1 of 2 points"),
        (ply("zip", b""), "no valid format"),
        (ply("ascii", b"", 10**30), "more than"),
        (ply("ascii", b"").replace(b"vertex 2", b"vertex -2"), "not `vertex`"),
        (ply("ascii", b"").replace(b"element vertex", b"element camera"), "not `vertex`"),
        (ply("ascii", b"").replace(b"float x", b"list uchar float x"), "a list"),
        (ply("ascii", b"").replace(b"float x", b"float w"), "have no x"),
        (ply("ascii", b"").replace(b"end_header\n", b""), "without a end_header"),
    ],
)
def test_a_ply_that_lies_is_refused(tmp_path: Path, data: bytes, complaint: str) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=complaint):
        load_cloud(0, "lidar", path)


@given(st.sampled_from([ply(form, body) for form, body in PLY.items()]), st.data())
def test_no_mutation_of_a_ply_ends_otherwise_than_in_its_error(whole: bytes, data: st.DataObject) -> None:
    mutated = bytearray(whole)
    for _ in range(data.draw(st.integers(0, 4))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        table = parse_ply(bytes(mutated[: data.draw(st.integers(0, len(mutated)))]))
    except TableError:
        return
    assert {"x", "y", "z"} <= set(table.dtype.names or ())
