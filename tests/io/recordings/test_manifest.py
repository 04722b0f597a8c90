"""`dataset.yaml`: what CONTRACT allows, what it refuses, and the real recordings."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import CameraFrame, EgoMotion, ImageFormat, LidarFrame
from coec.config import LimitsConfig
from coec.errors import SourceError
from coec.geometry import cameras, se3
from coec.geometry.sweep_kernels import deskew
from coec.io.images import decode_bgr, decode_depth
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import FramewiseRecording, damaged_of
from support.recordings import pcd
from support.scenes import ROOF_POSE, sweep_in_frame, turning_sweep

LIMITS = LimitsConfig()


def a_dataset(folder: Path, **changes: Any) -> Path:
    """Two frames, with everything that is optional in the first."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "1.jpg"), pixels)
    cv2.imwrite(str(folder / "2.png"), pixels)
    cv2.imwrite(str(folder / "3.bmp"), pixels)
    np.save(folder / "1.npy", np.ones((5, 3), np.float32))
    np.save(folder / "2.npy", np.ones((5, 3), np.float32))
    cv2.imwrite(str(folder / "depth.png"), np.full((12, 16), 1234, np.uint16))
    cv2.imwrite(str(folder / "mask.png"), np.full((48, 64), 255, np.uint8))
    document = {
        "pair": "front",
        "camera": {"model": "pinhole", "width": 64, "height": 48, "fx": 50, "fy": 51, "cx": 31.5, "cy": 23.5},
        "T_camera_lidar": [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]],
        "mask": "mask.png",
        "frames": [
            {
                "image": "1.jpg",
                "cloud": "1.npy",
                "stamp_ns": 1000,
                "cloud_stamp_ns": 900,
                "depth": "depth.png",
                "twist": {"linear_mps": [1, 2, 3], "angular_radps": [4, 5, 6]},
            },
            {"image": "2.png", "cloud": "2.npy", "stamp_ns": 2000},
        ],
        **changes,
    }
    with (folder / "dataset.yaml").open("w") as stream:
        YAML().dump(document, stream)
    return folder


def frames_of(folder: Path) -> list[CameraFrame]:
    return [m for m in open_source(str(folder)).messages() if isinstance(m, CameraFrame)]


def test_everything_the_contract_names(tmp_path: Path) -> None:
    a_dataset(tmp_path)
    for spec in (tmp_path, tmp_path / "dataset.yaml"):
        recording = open_source(str(spec))
        assert recording.rig.pair == "front"
        assert recording.rig.camera == cameras.build("pinhole", width=64, height=48, fx=50, fy=51, cx=31.5, cy=23.5)
        assert recording.rig.mask is not None
        assert recording.rig.mask.all()
        assert recording.rig.T_camera_lidar_nominal[:3, 3].tolist() == [0.1, 0.2, 0.3]
        messages = list(recording.messages())
        assert [(type(m), m.stamp_ns) for m in messages] == [
            (LidarFrame, 900),
            (EgoMotion, 1000),
            (CameraFrame, 1000),
            (LidarFrame, 2000),
            (CameraFrame, 2000),
        ]
        motion, camera = messages[1], messages[2]
        assert isinstance(motion, EgoMotion)
        assert (motion.linear_mps, motion.angular_radps) == ((1, 2, 3), (4, 5, 6))
        assert motion.frame_id == recording.rig.lidar_frame
        assert np.array_equal(recording.rig.T_lidar_ego, np.eye(4))
        assert isinstance(camera, CameraFrame)
        assert camera.image.data == (tmp_path / "1.jpg").read_bytes()
        assert camera.depth is not None
        assert camera.depth.data == (tmp_path / "depth.png").read_bytes()


def test_images_are_passed_on_as_they_are_or_as_raw_pixels(tmp_path: Path) -> None:
    frame = {"cloud": "1.npy", "stamp_ns": 0, "image": "3.bmp"}
    (image,) = frames_of(a_dataset(tmp_path, frames=[frame]))
    assert image.image.format is ImageFormat.BGR8
    expected = cv2.imread(str(tmp_path / "2.png"))
    assert expected is not None
    assert np.array_equal(decode_bgr(image.image, LIMITS), expected)


def test_float_depth_becomes_codes_in_the_same_order_on_one_scale(tmp_path: Path) -> None:
    frames = [{"image": "1.jpg", "cloud": f"{i}.npy", "stamp_ns": i, "depth": f"d{i}.npy"} for i in (1, 2)]
    a_dataset(tmp_path, frames=frames)
    np.save(tmp_path / "d1.npy", np.array([[2.0, 1.0, np.nan], [0.0, -1.0, np.inf]], np.float32))
    np.save(tmp_path / "d2.npy", np.array([[3.0, 1.5, 1.0]], np.float64))
    first, second = (decode_depth(f.depth, LIMITS) for f in frames_of(tmp_path) if f.depth is not None)
    assert first[0, :2].tolist() == [1 + 32767, 1]
    assert np.isnan(first).tolist() == [[False, False, True], [True, True, True]]
    assert second.tolist() == [[65535, 16385, 1]]
    np.save(tmp_path / "d2.npy", np.full((2, 2), 7.0))
    np.save(tmp_path / "d1.npy", np.full((2, 2), 7.0))
    assert all((decode_depth(f.depth, LIMITS) == 1).all() for f in frames_of(tmp_path) if f.depth is not None)


def test_frames_are_sorted_by_their_stamps(tmp_path: Path) -> None:
    frames = [{"image": "1.jpg", "cloud": "1.npy", "stamp_ns": stamp} for stamp in (30, 10, 20)]
    assert open_source(str(a_dataset(tmp_path, frames=frames))).camera_stamps_ns == (10, 20, 30)


IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FRAME = {"image": "1.jpg", "cloud": "1.npy", "stamp_ns": 0}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"colour": "red"}, "colour: there is no such key"),
        ({"frames": []}, "frames: Tuple should have at least 1"),
        ({"frames": [{**FRAME, "stamp": 1}]}, r"frames\.0\.stamp: there is no such key"),
        ({"frames": [{"image": "1.jpg", "stamp_ns": 0}]}, r"frames\.0\.cloud: is missing"),
        ({"frames": [{**FRAME, "stamp_ns": -1}]}, r"frames\.0\.stamp_ns"),
        ({"frames": [{**FRAME, "stamp_ns": 2**63}]}, r"frames\.0\.stamp_ns"),
        ({"frames": [{**FRAME, "image": "absent.jpg"}]}, r"there is no file absent\.jpg"),
        ({"frames": [{**FRAME, "depth": "1.jpg"}]}, r"depth 1\.jpg is neither"),
        ({"frames": [FRAME, FRAME, {**FRAME, "stamp_ns": 9}]}, "same stamp"),
        ({"frames": [{**FRAME, "cloud_stamp_ns": 5}, {**FRAME, "stamp_ns": 1}]}, "order of their images"),
        ({"frames": [{**FRAME, "twist": {"linear_mps": [1, 2, 3]}}]}, "angular_radps: is missing"),
        ({"T_camera_lidar": [*IDENTITY[:3], [0, 0, 0, 2]]}, "T_camera_lidar is not a rigid"),
        ({"T_camera_lidar": IDENTITY[:3]}, "T_camera_lidar"),
        ({"camera": {"model": "pinhole", "width": 64, "height": 48}}, r"camera\.fx: is missing"),
        ({"mask": "absent.png"}, "cannot read mask"),
        ({"mask": "depth.png"}, "the mask is 16 x 12 px"),
        ({"pair": "front/left"}, "pair: String should match"),
        ({"cloud_columns": ["x", "y", "intensity"]}, r"cloud_columns: .*has to name x, y and z"),
        ({"cloud_columns": ["x", "y", "z", "z"]}, r"cloud_columns: .*no column twice"),
        ({"cloud_time": {"field": "t", "unit": "h"}}, "cloud_time"),
    ],
)
def test_what_the_contract_does_not_allow_is_refused_by_place(
    tmp_path: Path, changes: dict[str, Any], complaint: str
) -> None:
    a_dataset(tmp_path, **changes)
    with pytest.raises(SourceError, match=complaint) as caught:
        open_source(str(tmp_path))
    assert "dataset.yaml" in str(caught.value)


def numbered(*stamps_ns: float) -> dict[str, Any]:
    return {"frames": [{**FRAME, "stamp_ns": stamp_ns} for stamp_ns in stamps_ns]}


@pytest.mark.parametrize(
    ("changes", "way_out"),
    [
        ({"T_lidar_camera": IDENTITY}, "T_camera_lidar and T_lidar_camera are given: give one of them"),
        ({"camera_from_lidar": IDENTITY}, "the pose is called `T_camera_lidar`"),
        (numbered(1600000000.5, 1600000000.6), r"frames\.0\.stamp_ns: .*multiply seconds by 1000000000"),
        (numbered(1600000000, 1600000002), "looks like seconds: multiply every stamp by 1000000000"),
        (numbered(1600000000000, 1600000000100), "looks like milliseconds: multiply every stamp by 1000000$"),
        (numbered(0, 0, 0), "all 3 frames have the stamp_ns 0: .*number them: 0, 100000000"),
        ({"camera": {"camera_matrix": {"data": [0.0] * 9}}}, "image_width is missing"),
        ({"camera": "a\0b"}, "a name in a path has no zero byte"),
        ({"camera": {"k": [10**400], "width": 64, "height": 48}}, "camera_matrix is no list of numbers"),
        ({"camera": "absent.yaml"}, r"there is no file .*absent\.yaml"),
    ],
)
def test_what_people_write_by_mistake_is_refused_with_the_way_out(
    tmp_path: Path, changes: dict[str, Any], way_out: str
) -> None:
    a_dataset(tmp_path, **changes)
    with pytest.raises(SourceError, match=way_out):
        open_source(str(tmp_path))


def first_sweep(folder: Path) -> LidarFrame:
    return next(m for m in open_source(str(folder)).messages() if isinstance(m, LidarFrame))


def test_what_is_recognised_in_the_clouds_is_reported_and_can_be_overridden(tmp_path: Path) -> None:
    a_dataset(tmp_path, frames=[FRAME])
    np.save(tmp_path / "1.npy", np.column_stack([np.ones((5, 4)), np.arange(5) * 0.02]))
    (recognition,) = first_sweep(tmp_path).recognitions
    assert (recognition.level, recognition.code) == ("ok", "cloud_columns")
    assert "read as x y z intensity _" in recognition.text
    a_dataset(
        tmp_path,
        frames=[FRAME],
        cloud_columns=["x", "y", "z", "_", "late"],
        cloud_time={"field": "late", "unit": "s"},
    )
    np.save(tmp_path / "1.npy", np.column_stack([np.ones((5, 4)), np.arange(5) * 0.02]))
    sweep = first_sweep(tmp_path)
    assert sweep.recognitions == ()
    assert sweep.intensity is None
    assert sweep.time_offset_s is not None
    assert sweep.time_offset_s[-1] == pytest.approx(0.08)


@pytest.mark.parametrize(("viewpoint", "codes"), [("0 0 0 1 0 0 0", []), ("1 0.5 0.2 0.99 0 0 0.1", ["viewpoint"])])
def test_a_viewpoint_is_not_applied_but_named(tmp_path: Path, viewpoint: str, codes: list[str]) -> None:
    head = pcd("x y z", "4 4 4", "F F F", 1, "ascii").replace(b"WIDTH", f"VIEWPOINT {viewpoint}\nWIDTH".encode())
    (tmp_path / "1.pcd").write_bytes(head + b"1 2 3\n")
    a_dataset(tmp_path, frames=[{**FRAME, "cloud": "1.pcd"}])
    sweep = first_sweep(tmp_path)
    assert [recognition.code for recognition in sweep.recognitions] == codes
    assert all("T_cloud_lidar" in recognition.text for recognition in sweep.recognitions)
    assert sweep.xyz_m.tolist() == [[1, 2, 3]]


def test_the_extrinsic_in_other_forms_and_directions(tmp_path: Path) -> None:
    a_dataset(tmp_path)
    T = open_source(str(tmp_path)).rig.T_camera_lidar_nominal
    text = (tmp_path / "dataset.yaml").read_text()
    begin, end = text.index("T_camera_lidar:"), text.index("mask:")
    for written in (
        f"T_lidar_camera: {se3.inverse(T).tolist()}",
        "T_camera_lidar: {xyz: [0.1, 0.2, 0.3], rpy_deg: [90, -90, 0]}",
        "T_camera_lidar: {xyz: [0.1, 0.2, 0.3], quaternion_xyzw: [0.5, -0.5, 0.5, 0.5]}",
        "T_camera_cloud: {xyz: [0.1, 0.2, 0.3], rpy_rad: [1.5707963267948966, -1.5707963267948966, 0]}",
    ):
        (tmp_path / "dataset.yaml").write_text(f"{text[:begin]}{written}\n{text[end:]}")
        assert open_source(str(tmp_path)).rig.T_camera_lidar_nominal == pytest.approx(T, abs=1e-9)


def test_a_pose_from_the_frame_of_the_cloud(tmp_path: Path) -> None:
    T_cloud_lidar = {"xyz": [1.0, 2.0, 3.0], "rpy_deg": [0, 0, 90]}
    a_dataset(tmp_path, T_cloud_lidar=T_cloud_lidar)
    text = (tmp_path / "dataset.yaml").read_text().replace("T_camera_lidar", "T_camera_cloud")
    (tmp_path / "dataset.yaml").write_text(text)
    rig = open_source(str(tmp_path)).rig
    p_cloud = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]]) @ [5.0, 6.0, 7.0, 1.0]
    expected = [-p_cloud[1] + 0.1, -p_cloud[2] + 0.2, p_cloud[0] + 0.3]
    assert (rig.T_camera_lidar_nominal @ [5.0, 6.0, 7.0, 1.0])[:3] == pytest.approx(expected)
    assert rig.cloud is not None


def test_a_cloud_in_millimetres_is_refused(tmp_path: Path) -> None:
    a_dataset(tmp_path)
    np.save(tmp_path / "1.npy", 4000.0 * np.ones((5, 3), np.float32))
    with pytest.raises(SourceError, match=r"half of the points are farther than .*divide millimetres by 1000"):
        list(open_source(str(tmp_path)).messages())


def test_stamps_that_can_be_nanoseconds_are_taken_as_they_are(tmp_path: Path) -> None:
    a_dataset(tmp_path, **numbered(1600000000, 1700000000))
    assert open_source(str(tmp_path)).camera_stamps_ns == (1600000000, 1700000000)


NUMBERS = {"width": 64, "height": 48, "fx": 50, "fy": 51, "cx": 31.5, "cy": 23.5}
POLYNOMIAL = {"k1": -0.1, "k2": 0.01, "p1": 0.001, "p2": 0.002, "k3": 0.003}


@pytest.mark.parametrize(
    ("ros", "ours", "parameters"),
    [
        ("plumb_bob", "radtan", POLYNOMIAL),
        ("rational_polynomial", "rational", {**POLYNOMIAL, "k4": 0.1, "k5": 0.01, "k6": 0.001}),
        ("equidistant", "kannala_brandt", {"k1": 0.1, "k2": 0.01, "k3": 0.001, "k4": 0.0}),
        ("fisheye", "kannala_brandt", {"k1": 0.1, "k2": 0.01, "k3": 0.001, "k4": 0.0}),
    ],
)
def test_models_of_lenses_may_have_the_names_of_ros(
    tmp_path: Path, ros: str, ours: str, parameters: dict[str, float]
) -> None:
    a_dataset(tmp_path, camera={"model": ros, **NUMBERS, **parameters})
    camera = open_source(str(tmp_path)).rig.camera
    assert cameras.name_of(camera) == ours
    assert cameras.intrinsics_of(camera) == {**NUMBERS, **parameters}


K = [50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0]
CAMERA_INFO = {
    "image_width": 64, "image_height": 48, "camera_name": "front", "distortion_model": "plumb_bob",
    "camera_matrix": {"rows": 3, "cols": 3, "data": K},
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(POLYNOMIAL.values())},
}  # fmt: skip
ECHOED = {
    "header": {"frame_id": "optical"}, "width": 64, "height": 48, "distortion_model": "plumb_bob", "k": K,
    "d": list(POLYNOMIAL.values()),
}  # fmt: skip


@pytest.mark.parametrize("info", [CAMERA_INFO, ECHOED], ids=["camera_calibration", "ros2 topic echo"])
@pytest.mark.parametrize("neighbour", [True, False], ids=["named", "within"])
def test_a_camera_info_is_taken_as_the_camera(tmp_path: Path, info: dict[str, Any], *, neighbour: bool) -> None:
    with (tmp_path / "camera_info.yaml").open("w") as stream:
        YAML().dump(info, stream)
    a_dataset(tmp_path, camera="camera_info.yaml" if neighbour else info)
    camera = open_source(str(tmp_path)).rig.camera
    assert cameras.intrinsics_of(camera) == {**NUMBERS, **POLYNOMIAL}
    with pytest.raises(SourceError, match=r"name it as `camera: camera_info\.yaml`"):
        open_source(str(tmp_path / "camera_info.yaml"))


def test_points_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    a_dataset(tmp_path)
    points = np.ones((7, 3), np.float32)
    points[3] = np.nan
    np.save(tmp_path / "1.npy", points)
    sweep = next(m for m in open_source(str(tmp_path)).messages() if isinstance(m, LidarFrame))
    assert (len(sweep.xyz_m), sweep.not_finite) == (6, 1)


def test_files_that_lie_are_named_when_it_is_their_turn(tmp_path: Path) -> None:
    a_dataset(tmp_path)
    (tmp_path / "2.png").write_bytes((tmp_path / "2.png").read_bytes()[:-20])
    recording = open_source(str(tmp_path))
    assert [type(m) for m in recording.messages()].count(CameraFrame) == 1
    assert "1 damaged (1 image_truncated); the first: " in damaged_of(recording).text
    assert "2.png: the PNG has no end" in damaged_of(recording).text
    (tmp_path / "2.png").write_text("no image at all")
    recording = open_source(str(tmp_path))
    list(recording.messages())
    assert "not an image that OpenCV reads" in damaged_of(recording).text
    (tmp_path / "dataset.yaml").write_text("frames: [")
    with pytest.raises(SourceError, match="not valid YAML"):
        open_source(str(tmp_path))


def test_the_garage(sample_data: Path) -> None:
    recording = open_source(str(sample_data / "fisheye_garage"))
    assert len(recording.camera_stamps_ns) == 5
    assert cameras.name_of(recording.rig.camera) == "kannala_brandt"
    messages = list(recording.messages([2]))
    assert [type(m) for m in messages] == [LidarFrame, CameraFrame]


def test_the_raw_fisheye_with_its_mask(sample_data: Path) -> None:
    recording = open_source(str(sample_data / "kitti360_fisheye"))
    assert recording.rig.mask is not None
    assert 0.3 < recording.rig.mask.mean() < 0.95
    assert len(list(recording.messages())) == 2


def test_clouds_in_another_frame_come_back_to_the_lidars(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "given.npz",
        xyz=sweep_in_frame(turning_sweep(), ROOF_POSE).xyz_m,
        ring=np.asarray(turning_sweep().ring),
    )
    frames = [{"image": "1.jpg", "cloud": "given.npz", "stamp_ns": 1000}]
    a_dataset(tmp_path, T_cloud_lidar=[[float(v) for v in row] for row in ROOF_POSE], frames=frames)
    (sweep,) = (m for m in open_source(str(tmp_path)).messages() if isinstance(m, LidarFrame))
    np.testing.assert_allclose(sweep.xyz_m, turning_sweep().xyz_m, atol=1e-5)
    a_dataset(tmp_path, frames=frames)
    with pytest.raises(SourceError, match=r"given.npz: The points contradict their origin.*`T_cloud_lidar`"):
        list(open_source(str(tmp_path)).messages())
    # In a table all columns are floats, and seen from elsewhere the beams have no elevations of their own.
    table = np.column_stack([sweep_in_frame(turning_sweep(), ROOF_POSE).xyz_m, np.asarray(turning_sweep().ring)])
    np.save(tmp_path / "given.npy", table.astype(np.float32))
    a_dataset(tmp_path, frames=[{**frames[0], "cloud": "given.npy"}], cloud_columns=["x", "y", "z", "ring"])
    with pytest.raises(SourceError, match=r"given.npy: The points contradict their origin.*`T_cloud_lidar`"):
        list(open_source(str(tmp_path)).messages())


def test_compensated_clouds_are_recognised_by_their_turn(tmp_path: Path) -> None:
    """As in bags; points of a vehicle at 10 m/s, compensated for the begin of each sweep."""
    motion = EgoMotion(0, "lidar", (10.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    frames = []
    for number in range(6):
        sweep = turning_sweep(number)
        share = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]) / (2 * np.pi) + 0.5
        xyz_m = deskew(sweep.xyz_m, share.astype(np.float64) * 0.1, *sensor_twist(motion, np.eye(4)))
        assert sweep.ring is not None
        np.savez(tmp_path / f"{number}.npz", xyz=xyz_m, ring=sweep.ring, time_offset_s=(share * 0.1).astype(np.float32))
        twist = {"linear_mps": [10, 0, 0], "angular_radps": [0, 0, 0]}
        stamp_ns = 1_000_000_000 + number * 100_000_000
        frames.append({"image": "1.jpg", "cloud": f"{number}.npz", "stamp_ns": stamp_ns, "twist": twist})

    def times_s(**changes: Any) -> tuple[list[str], np.ndarray]:
        recording = open_source(str(a_dataset(tmp_path, frames=frames, **changes)))
        assert isinstance(recording, FramewiseRecording)
        sweeps = [message for message in recording.messages() if isinstance(message, LidarFrame)]
        assert sweeps[0].time_offset_s is not None
        return [one.code for one in recording.recognitions], sweeps[0].time_offset_s

    codes, recognised_s = times_s()
    assert codes == ["already_compensated"]
    assert not recognised_s.any()
    for no in ("no", False):
        codes, given_s = times_s(compensated=no)
        assert codes == []
        assert np.ptp(given_s) > 0.09
    assert times_s(compensated="middle")[1] == pytest.approx(0.05, abs=0.001)


def test_an_empty_folder_and_the_configuration_of_a_service_are_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"has neither a dataset\.yaml nor files of a bag"):
        open_source(str(tmp_path))
    path = tmp_path / "coec.yaml"
    path.write_text("vehicle: shuttle\npairs: []\n")
    with pytest.raises(SourceError, match=r"is the configuration of a service .*, not a dataset\.yaml"):
        open_source(str(path))
