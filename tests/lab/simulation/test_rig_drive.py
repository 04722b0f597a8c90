"""A rig on one drive: its sensors, its pairs, its faults, its truth."""

import pickle
from collections import Counter
from functools import lru_cache

import cv2
import numpy as np
import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import CameraFrame, EgoMotion, Frame, FramePair, LidarFrame
from coec.config import LimitsConfig
from coec.errors import UsageError
from coec.geometry.cameras import in_image
from coec.geometry.projection import project
from coec.geometry.se3 import difference, inverse
from coec.io.images import decode_depth
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import HasGroundTruth
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.rig_drive import RigDrive, SimulatedRigPair
from coec_lab.simulation.scene import Solid
from coec_lab.simulation.simulated_sensors import NEAREST_M
from coec_lab.simulation.source import open_rig
from coec_lab.simulation.vehicle_motion import whole_body

pytestmark = pytest.mark.usefixtures("streets")

TEXT = "rig=four-fisheyes&seed=4&seconds=0.5&camera=fisheye128&camera_hz=2&lidar_hz=2&ego_hz=20"


def drive(*faults: str, **more: str) -> RigDrive:
    query = dict(word.split("=") for word in TEXT.split("&")) | more
    return open_rig(query | ({"faults": ";".join(faults)} if faults else {}))


@lru_cache(maxsize=1)
def plain() -> tuple[Frame, ...]:
    """The drive without any fault."""
    return tuple(drive(depth="yes").messages())


def content(message: Frame) -> object:
    match message:
        case CameraFrame():
            return message.frame_id, message.stamp_ns, message.image.data
        case LidarFrame():
            return message.frame_id, message.stamp_ns, message.xyz_m.tobytes()
    return message


def by_sensor(messages: tuple[Frame, ...] | list[Frame]) -> dict[str, Frame]:
    """The first of each."""
    return {message.frame_id: message for message in reversed(messages)}


def test_every_sensor_speaks_at_its_own_stamps() -> None:
    counts = Counter(message.frame_id for message in plain())
    sensors = ("front", "left", "rear", "right", "roof", "near_left", "near_right")
    assert counts == Counter({"ego": 10} | dict.fromkeys(sensors, 1))
    stamps = [message.stamp_ns for message in plain()]
    assert stamps == sorted(stamps)
    assert len({message.stamp_ns for message in plain() if not isinstance(message, EgoMotion)}) == len(sensors)


def test_a_pair_has_the_frames_of_the_rig_and_draws_no_others() -> None:
    pair = open_source(f"sim:{TEXT}&pair=left-near_left")
    assert isinstance(pair, HasGroundTruth)
    assert pair.rig.pair == "left-near_left"
    ours = [content(message) for message in pair.messages()]
    theirs = [content(message) for message in plain() if message.frame_id in ("left", "near_left", "ego")]
    assert ours == theirs
    assert (len(pair.camera_stamps_ns), len(pair.sweep_stamps_ns), len(pair.motion_stamps_ns)) == (1, 1, 10)
    assert [content(message) for message in pair.messages([0])] == theirs


def test_another_process_makes_the_same_parts() -> None:
    config = pickle.loads(pickle.dumps(drive(depth="yes").config))
    whole = plain()
    assert config.drive().message_count == len(whole)
    assert list(map(content, config.drive().part(3, 9))) == list(map(content, whole[3:9]))


@pytest.mark.parametrize(("camera", "lidar"), [("front", "roof"), ("rear", "roof"), ("left", "near_left")])
def test_points_of_a_lidar_project_onto_the_depth_of_a_camera(camera: str, lidar: str) -> None:
    frames = by_sensor(plain())
    eye, cloud = frames[camera], frames[lidar]
    assert isinstance(eye, CameraFrame)
    assert isinstance(cloud, LidarFrame)
    motions = [message for message in plain() if isinstance(message, EgoMotion)]
    motion = min(motions, key=lambda message: abs(message.stamp_ns - eye.stamp_ns))
    pair = drive().pair(camera, lidar)
    xyz = compensate(FramePair(eye, cloud, motion), pair.rig, enabled=True).astype(np.float64)
    T = pair.truth(eye.stamp_ns)
    p_camera = xyz @ T[:3, :3].T + T[:3, 3]
    uv, valid = project(pair.rig.camera, p_camera)
    retained = valid & in_image(pair.rig.camera, uv)
    u, v = np.rint(uv[retained]).astype(int).T
    assert eye.depth is not None
    assert pair.rig.mask is not None
    code = decode_depth(eye.depth, LimitsConfig())[v, u].astype(np.float64)
    used = (code > 1) & pair.rig.mask[v, u]
    range_m = 65535 * NEAREST_M / code[used]
    error = np.abs(np.linalg.norm(p_camera[retained][used], axis=1) - range_m)
    assert used.sum() > 1000
    # A pixel is more than a degree wide, and things hide behind others from one place and not from the other.
    assert (error < 0.15 + 0.05 * range_m).mean() > 0.75


def test_a_fault_belongs_to_its_sensor_and_turns_it_about_its_own_axes() -> None:
    displaced = drive(
        "front:step:0:ry=3", "near_left:step:0:rz=2", "right:dark:0", "roof:beams:0:share=0.5", depth="yes"
    )
    after = by_sensor(list(displaced.messages()))
    before = by_sensor(plain())
    changed = {name for name in before if content(before[name]) != content(after[name])}
    assert changed == {"front", "near_left", "right", "roof"}
    stamp_ns = START_NS + 100_000_000
    for sensor, expected in (("front", (0, 3, 0)), ("near_left", (0, 0, 2)), ("rear", (0, 0, 0))):
        xi = difference(displaced.T_sensor_ego(sensor, stamp_ns), displaced.T_sensor_ego_nominal(sensor))
        np.testing.assert_allclose(np.rad2deg(xi[:3]), expected, atol=1e-9)
    moved = {
        (camera, lidar): np.rad2deg(np.linalg.norm(difference(pair.truth(stamp_ns), pair.T_camera_lidar_start)[:3]))
        for camera, lidar in (("front", "roof"), ("front", "near_left"), ("rear", "near_left"), ("rear", "roof"))
        for pair in (displaced.pair(camera, lidar),)
    }
    assert moved["front", "roof"] == pytest.approx(3.0)
    assert moved["rear", "near_left"] == pytest.approx(2.0)
    assert moved["rear", "roof"] == pytest.approx(0.0, abs=1e-9)
    assert moved["front", "near_left"] > 3.0


def test_a_displaced_lidar_measures_the_same_world_from_its_new_pose() -> None:
    """With its true pose the points lie where they did, with the nominal one they do not."""
    displaced = drive("roof:step:0:rx=4")
    cloud, still = (by_sensor(list(messages))["roof"] for messages in (displaced.messages(), plain()))
    assert isinstance(cloud, LidarFrame)
    assert isinstance(still, LidarFrame)

    def heights(frame: LidarFrame, T_lidar_ego: np.ndarray) -> np.ndarray:
        T = inverse(T_lidar_ego)
        xyz = frame.xyz_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        near = np.hypot(xyz[:, 0], xyz[:, 1]) < 12.0
        return np.asarray(xyz[near & (xyz[:, 2] < 0.8), 2])

    def spread(frame: LidarFrame, T: np.ndarray) -> float:
        """Of the road, which is flat."""
        return float(np.subtract(*np.percentile(heights(frame, T), [75, 25])))

    flat = spread(still, drive().T_sensor_ego("roof", still.stamp_ns))
    assert spread(cloud, displaced.T_sensor_ego("roof", cloud.stamp_ns)) < flat + 0.05
    assert spread(cloud, displaced.T_sensor_ego_nominal("roof")) > flat + 0.1


def test_the_workshop_may_be_wrong_about_a_sensor() -> None:
    made = drive(workshop="roof:0,0,1;left:0,1,0,0.1,0,0")
    off = {
        sensor: difference(made.T_sensor_ego_nominal(sensor), made.T_sensor_ego(sensor, START_NS))
        for sensor in ("roof", "left", "front")
    }
    np.testing.assert_allclose(off["roof"], [0, 0, np.deg2rad(1.0), 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(off["left"], [0, np.deg2rad(1.0), 0, 0.1, 0, 0], atol=1e-12)
    assert not np.abs(off["front"]).max() > 1e-12


def test_no_sensor_sits_within_the_body_and_none_measures_it() -> None:
    body = Solid(whole_body())
    frames = by_sensor(plain())
    made = drive()
    for sensor in made.lidars:
        cloud = frames[sensor]
        assert isinstance(cloud, LidarFrame)
        T = inverse(made.T_sensor_ego(sensor, START_NS))
        rays = (cloud.xyz_m.astype(np.float64) @ T[:3, :3].T).astype(np.float32)
        origins = np.broadcast_to(T[:3, 3].astype(np.float32), rays.shape)
        assert not body.blocked(np.ascontiguousarray(origins), rays).any()
        assert len(cloud.xyz_m) > 1000
    for camera in made.cameras:
        assert 0.25 < made.mask(camera).mean() < 0.75
        eye = frames[camera]
        assert isinstance(eye, CameraFrame)
        grey = cv2.imdecode(np.frombuffer(eye.image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        assert grey[made.mask(camera)].std() > 10


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("rig=five", "choose one of four-fisheyes"),
        ("rig=four-fisheyes", "one pair of the rig is a recording: write pair="),
        ("rig=four-fisheyes&pair=roof-front", "front-roof"),
        ("rig=four-fisheyes&pair=front-roof&lidar=64", "unknown query key lidar"),
        ("rig=four-fisheyes&pair=front-roof&camera=pinhole64x64", "this rig has fisheyes"),
        ("rig=four-fisheyes&pair=front-roof&faults=step:3:ry=1", "of which sensor"),
        ("rig=four-fisheyes&pair=front-roof&faults=nose:step:3:ry=1", "no sensor and no fault 'nose'"),
        ("rig=four-fisheyes&pair=front-roof&faults=front:beams:3", "no fault of a camera"),
        ("rig=four-fisheyes&pair=front-roof&faults=roof:dirt:3", "no fault of a LiDAR"),
        ("rig=four-fisheyes&pair=front-roof&faults=front:night:3", "no fault of a camera"),
        ("rig=four-fisheyes&pair=front-roof&workshop=0,1,0", "of which sensor"),
        ("rig=four-fisheyes&pair=front-roof&workshop=nose:0,1,0", "no sensor nose"),
        ("rig=four-fisheyes&pair=front-roof&workshop=front:0,1", "rx,ry,rz"),
        ("rig=four-fisheyes&pair=front-roof&scene=moon", "choose one of street"),
    ],
)
def test_what_does_not_fit_is_refused(text: str, reported: str) -> None:
    with pytest.raises(UsageError, match=reported):
        open_source(f"sim:{text}")


def test_loss_is_of_whom_it_is_reported() -> None:
    text = {"seconds": "10"}
    of_all = Counter(entry.stream for entry in drive("loss:0:share=1", **text).plan)
    assert not of_all
    made = drive("rear:loss:0:share=1", "no-ego:0", **text)
    received = {stream for _, stream, _ in made.plan}
    assert received == {made.stream(name) for name in (*made.cameras, *made.lidars) if name != "rear"}


def test_night_is_everywhere() -> None:
    made = drive("night:0", camera="fisheye64")
    for name in ("front", "rear"):
        frame = next(frame for frame in made.pair(name, "near_left").messages([0]) if isinstance(frame, CameraFrame))
        grey = cv2.imdecode(np.frombuffer(frame.image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        seen = made.mask(name)
        assert np.percentile(grey[seen], 40) < 60 < np.percentile(grey[seen], 99.5)


def test_a_pair_is_a_recording_of_the_rig_that_it_was_requested_of() -> None:
    made = drive("roof:step:0.2:rz=1")
    one, other = made.pair("front", "roof"), made.pair("right", "roof")
    assert isinstance(one, SimulatedRigPair)
    late_ns = START_NS + 300_000_000
    for pair in (one, other):  # a knocked LiDAR is the same knock in every pair that has it
        xi = difference(pair.truth(late_ns), pair.truth(START_NS))
        assert np.rad2deg(np.linalg.norm(xi[:3])) == pytest.approx(1.0)
