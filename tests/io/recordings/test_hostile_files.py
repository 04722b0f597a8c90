"""Files that somebody damaged or made to do harm: every reader ends in a recording or in an error of ours, soon and
with little memory."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml.scanner import Scanner

from coec.config import MAX_YAML_BYTES, load_config, load_yaml, parse_yaml
from coec.errors import CoecError, ConfigError, SourceError
from coec.io import user_files
from coec.io.recordings.cloud_files import load_cloud
from coec.io.recordings.cloud_formats import MAX_TABLE_BYTES, MAX_UNPACKED_BYTES, TableError, parse_pcd
from coec.io.recordings.kitti import read_numbers, read_stamps
from coec.io.recordings.layouts import open_source
from support.recordings import npy, npy_with_header, npz, pcd

DEEP = 100_000
DIGITS = "9" * 5000
MB = 2**20


XYZ = ("x y z", "4 4 4", "F F F")
CLOUD = npy(np.ones((4, 3)))
ROWS = np.ones((4, 3), "<f4").tobytes()

HEADERS = {
    "no literal": "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 3), ",
    "no shape": "{'descr': '<f8', 'fortran_order': False}",
    "code": "{'descr': __import__('os'), 'fortran_order': False, 'shape': (4, 3)}",
    "nested": "[" * 90,
    "tokens": "{'descr': '''",
    "zero byte": "{'descr': '\0'}",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-4, 3), }",
    "immense": "{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000000000000, 3), }",
    "empty type": "{'descr': '<V0', 'fortran_order': False, 'shape': (9000000000, 3), }",
    "no type": "{'descr': [('x', 'y', 'z')], 'fortran_order': False, 'shape': (4, 3), }",
    "float shape": "{'descr': '<f8', 'fortran_order': False, 'shape': (4.5, 3), }",
}


@pytest.mark.fault("a damaged or hostile `.npy` or `.npz`", "an error of ours that names the file")
@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS)
@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_the_header_of_a_numpy_file_may_say_anything(tmp_path: Path, suffix: str, header: str) -> None:
    path = tmp_path / f"cloud.{suffix}"
    array = npy_with_header(header, bytes(96))
    path.write_bytes(array if suffix == "npy" else npz(xyz=array))
    with pytest.raises(SourceError, match=str(path)):
        load_cloud(0, "lidar", path)


@pytest.mark.fault("an `.npz` that unpacks to gigabytes", "it is refused before it is unpacked")
def test_an_archive_that_promises_more_than_it_holds_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cloud.npz"
    path.write_bytes(npz(xyz=npy_with_header(HEADERS["immense"].replace("9" + 18 * "0", "20000000"), bytes(96))))
    with pytest.raises(SourceError, match="promises more"):
        load_cloud(0, "lidar", path)
    monkeypatch.setattr(user_files, "MAX_FILE_BYTES", MB)
    bomb = npz(xyz=npy_with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (4, 3), }", bytes(2 * MB)))
    path.write_bytes(bomb)
    with pytest.raises(SourceError, match="would unpack"):
        load_cloud(0, "lidar", path)


def test_doubles_that_no_float_holds_go_with_their_point(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    path.write_bytes(npy(np.array([[1e300, 0, 0, 1], [1, 2, 3, 4]])))
    assert load_cloud(0, "lidar", path).xyz_m.tolist() == [[1, 2, 3]]
    path = tmp_path / "cloud.npz"
    path.write_bytes(npz(xyz=npy(np.ones((2, 3)) * [[1], [2]]), time_offset_s=npy(np.array([0.25, -1e300]))))
    assert load_cloud(0, "lidar", path).xyz_m.tolist() == [[1, 1, 1]]
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd(*XYZ, 2, "ascii", b"1e300 0 0\n1 2 3\n"))
    assert load_cloud(0, "lidar", path).xyz_m.tolist() == [[1, 2, 3]]
    path.write_bytes(pcd("x y z", "8 8 8", "F F F", 2, "binary", np.array([1e300, 0, 0, 1, 2, 3]).tobytes()))
    assert load_cloud(0, "lidar", path).xyz_m.tolist() == [[1, 2, 3]]


@pytest.mark.fault("a PCD with padding fields `_1 _`", "it is read")
@pytest.mark.parametrize(
    "fields", ["_1 _ x y z", "_ _0 x y z", "_ _ x y z", "_1 _2 x y z", "x x x y z", "_0 _ x _ y z"]
)
def test_padding_fields_may_have_any_name(fields: str) -> None:
    count = len(fields.split())
    data = pcd(fields, "4 " * count, "F " * count, 1, "binary", struct.pack(f"<{count}f", *range(count)))
    places = [fields.split().index(axis) for axis in "xyz"]
    assert [parse_pcd(data)[axis].tolist() for axis in "xyz"] == [[place] for place in places]


@pytest.mark.fault("the header of a PCD that promises gigabytes", "it is refused without their memory")
@pytest.mark.parametrize(
    "data",
    [
        pcd(*XYZ, 4, "ascii")
        .replace(b"WIDTH 4", b"WIDTH " + b"9" * 4000)
        .replace(b"HEIGHT 1", b"HEIGHT " + b"9" * 4000),
        pcd(*XYZ, 4, "ascii").replace(b"WIDTH 4", b"WIDTH " + DIGITS.encode()),
        pcd(*XYZ, 2**63, "binary"),
        pcd("x y z " + "f " * 9000, "4 " * 9003, "F " * 9003, 1, "binary"),
        pcd(*XYZ, 3_000_000, "binary", counts="1 1 1").replace(b"FIELDS x", b"FIELDS p x"),
        pcd("x y z p", "4 4 4 8", "F F F F", 1_000_000, "binary", counts="1 1 1 4096"),
        pcd(*XYZ, MAX_UNPACKED_BYTES // 12 + 1, "binary_compressed", bytes(8)),
        pcd(*XYZ, 3_999_999, "ascii", b"1 2 3\n"),
        pcd(*XYZ, 1000, "binary_compressed", struct.pack("<II", 24_000, 12_000) + bytes(24_000)),
        pcd(*XYZ, 1, "ascii", b"1 " * 40_000),
        pcd(*XYZ, 1, "ascii", DIGITS.encode() + b" 1\n"),
        pcd(*XYZ, 2, "ascii", b"1 2 3\n\n\n"),
        pcd("x y z t", "4 4 4 8", "F F F U", 1, "ascii", b"1 2 3 18446744073709551616\n"),
    ],
    ids=range(13),
)
def test_no_header_of_a_pcd_makes_it_large(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(TableError):
            parse_pcd(data)
        assert tracemalloc.get_traced_memory()[1] < MAX_TABLE_BYTES
    finally:
        tracemalloc.stop()


@pytest.mark.fault("a compressed PCD that grows a hundredfold", "memory stays within its bound")
def test_much_of_a_small_compressed_file_stays_within_its_bound() -> None:
    """References of 264 bytes for three of the file: the most that LZF can."""
    points = 2 * MB // 12
    whole, rest = divmod(points * 12 - 1, 264)
    packed = b"\x00\x00" + bytes([0xE0, 255, 0]) * whole + bytes(2) * rest
    data = pcd(*XYZ, points, "binary_compressed", struct.pack("<II", len(packed), points * 12) + packed)
    tracemalloc.start()
    try:
        assert len(parse_pcd(data)) == points
        assert tracemalloc.get_traced_memory()[1] < 6 * 2 * MB
    finally:
        tracemalloc.stop()


def test_text_rows_are_read_in_blocks_with_the_right_place_of_a_complaint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coec.io.recordings.cloud_formats.ASCII_BLOCK_BYTES", 20)
    rows = [f"{i} {i} {i}" for i in range(50)]
    head = pcd(*XYZ, 50, "ascii")
    assert parse_pcd(head + "\n".join(rows).encode())["z"].tolist() == list(range(50))
    bad = [*rows[:33], "1 2 x", *rows[34:]]
    with pytest.raises(TableError, match=f"line {len(head.splitlines()) + 34}: not a number"):
        parse_pcd(head + "\n".join(bad).encode())
    with pytest.raises(TableError, match="ends after 49 of 50"):
        parse_pcd(head + "\n".join(rows[:49]).encode() + b"\n\n")


@pytest.mark.fault("a cloud of gigabytes", "it is not read")
@pytest.mark.parametrize("suffix", ["bin", "pcd", "npy"])
def test_files_larger_than_a_file_may_be_are_not_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud.{suffix}"
    rows = user_files.MAX_FILE_BYTES // 24 + 1
    with path.open("wb") as stream:
        stream.write(npy_with_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({rows}, 3), }}"))
        stream.truncate(user_files.MAX_FILE_BYTES + 1024)
    tracemalloc.start()
    try:
        with pytest.raises(SourceError, match="too large"):
            load_cloud(0, "lidar", path)
        assert tracemalloc.get_traced_memory()[1] < MB
    finally:
        tracemalloc.stop()


YAML = {
    "flow": "[" * DEEP,
    "dashes": "- " * DEEP,
    "blocks": "".join(f"{' ' * depth}a:\n" for depth in range(500)),
    "40 deep": "pairs: " + "[" * 40 + "]" * 40,
    "digits": f"pairs: {DIGITS}",
    "a date": "pairs: 2001-99-99",
    "itself": "pairs: &a [*a]",
    "laughs": "a0: &a0 [1, 1]\n" + "".join(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9)),
    "a tag": "pairs: !!python/object:os.system x",
    "bytes": "pairs: !!binary '@@@'",
    "null byte": "pairs: \0",
    "keys": "? [1, {a: b}]\n: 3\n? {a: 1}\n: 3",
    "large": "#" * (MAX_YAML_BYTES + 1),
    "hex": "vehicle: 0x" + "f" * DEEP,
    "merged": "a0: &a0 {k0: 1}\n" + "".join(f"a{i + 1}: &a{i + 1} {{<<: *a{i}, k{i + 1}: 1}}\n" for i in range(9)),
}


@pytest.mark.fault(
    "YAML nested 100,000 deep, a billion laughs, numbers of 5,000 digits", "an error of ours that names the file"
)
@pytest.mark.parametrize("text", YAML.values(), ids=YAML)
def test_yaml_is_refused_by_an_error_of_ours(tmp_path: Path, text: str) -> None:
    path = tmp_path / "dataset.yaml"
    path.write_text(text)
    for read in (load_config, lambda path: open_source(str(path))) if len(text) < DEEP else (load_config,):
        with pytest.raises(CoecError, match=r"dataset\.yaml"):
            read(path)


@pytest.mark.fault("YAML of a megabyte of empty lists", "it is given up before all of its values are read")
@pytest.mark.parametrize("value", ["[]", "{}", "1"])
def test_yaml_is_given_up_before_all_of_its_values_are_read(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    one_more = Scanner.fetch_flow_entry

    def counted(scanner: Scanner) -> None:
        read.append(scanner)
        one_more(scanner)

    monkeypatch.setattr(Scanner, "fetch_flow_entry", counted)
    monkeypatch.setattr("coec.config.root.MAX_YAML_VALUES", 1000)
    with pytest.raises(ConfigError, match="more than 1000 values"):
        parse_yaml("[" + f"{value}," * 10_000 + "]")
    assert 900 < len(read) < 1100


@pytest.mark.parametrize("name", ["a\\0b", "x" * 300, "é" * 200, "../" * 2000])
@pytest.mark.parametrize("key", ["mask: %s", "frames: [{image: %s, cloud: a.bin, stamp_ns: 1}]"])
def test_a_path_that_no_file_can_have_is_refused_by_place(tmp_path: Path, key: str, name: str) -> None:
    (tmp_path / "dataset.yaml").write_text("pair: front\n" + key % f'"{name}"' + "\n")
    with pytest.raises(SourceError, match=r"dataset\.yaml.*(mask|frames\.0\.image): Value error, a (name in a )?path"):
        open_source(str(tmp_path))
    (tmp_path / "coec.yaml").write_text(f'state: {{directory: "{name}"}}\nzenoh: {{file: "{name}"}}\n')
    with pytest.raises(ConfigError, match=r"zenoh\.file: Value error.*state\.directory: Value error"):
        load_config(tmp_path / "coec.yaml")


def test_a_binary_file_is_no_yaml(tmp_path: Path) -> None:
    path = tmp_path / "dataset.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError):
        load_yaml(path)


# --- any bytes ------------------------------------------------------------------------------------------------------


def mutations(whole: bytes) -> st.SearchStrategy[bytes]:
    """A file with some bytes replaced, cut, or something put into it."""

    def mutated(edits: list[tuple[int, int, bytes]]) -> bytes:
        data = bytearray(whole)
        for at, removed, put in edits:
            at %= len(data) + 1
            data[at : at + removed] = put
        return bytes(data)

    pieces = st.one_of(
        st.binary(max_size=4),
        st.sampled_from([b"9" * 20, b"-", b"[", b"{", b"'", b"\n", b"nan", b"1e999", b"\xff" * 8]),
    )
    edit = st.tuples(st.integers(0, len(whole)), st.sampled_from([0, 1, 2, 8, len(whole)]), pieces)
    return st.lists(edit, max_size=4).map(mutated)


MANIFEST = (
    b"pair: front\n"
    b"camera: {model: pinhole, width: 4, height: 3, fx: 1, fy: 1, cx: 1, cy: 1}\n"
    b"T_camera_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    b"frames: [{image: a.png, cloud: a.npy, stamp_ns: 1, twist: {linear_mps: [1, 0, 0], angular_radps: [0, 0, 0]}}]\n"
)


def read_cloud(path: Path) -> None:
    frame = load_cloud(0, "lidar", path)
    assert np.isfinite(frame.xyz_m).all()


CORPUS: dict[str, tuple[str, bytes, Callable[[Path], object]]] = {
    "npy": ("a.npy", CLOUD, read_cloud),
    "npz": ("a.npz", npz(xyz=CLOUD, ring=npy(np.arange(4))), read_cloud),
    "bin": ("a.bin", ROWS + ROWS[:16], read_cloud),
    "ascii": ("a.pcd", pcd(*XYZ, 4, "ascii", b"1 2 3\n" * 4), read_cloud),
    "binary": ("a.pcd", pcd(*XYZ, 4, "binary", ROWS, counts="1 1 1"), read_cloud),
    "manifest": ("dataset.yaml", MANIFEST, lambda path: open_source(str(path))),
    "stamps": ("timestamps.txt", b"2013-05-28 08:46:02.904483072\n" * 2, read_stamps),
    "numbers": ("calib.txt", b"R: 1 0 0 0 1 0 0 0 1\nT: 1 2 3\n", read_numbers),
}


@pytest.mark.parametrize("kind", CORPUS)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_no_mutation_ends_otherwise_than_in_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    name, whole, read = CORPUS[kind]
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(data.draw(mutations(whole)))
    with suppress(CoecError):
        read(path)


@pytest.mark.parametrize("content", [b"", b"rubbish" * 99])
@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
def test_a_file_that_is_no_bag_is_not_called_a_damaged_one(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"drive.{suffix}"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"drive\.\w+ is no (bag|MCAP file)"):
        open_source(str(path))
