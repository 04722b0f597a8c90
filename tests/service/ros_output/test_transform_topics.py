"""Which frames ROS is told of: those that are served under a name that says so, each with one parent."""

from __future__ import annotations

import numpy as np
import pytest

from coec.config import RosConfig
from coec.geometry import se3
from coec.io.serialise import transform_of
from coec.schemas.replies import Axes, AxisReply, ExtrinsicReply, Provenance
from coec.service.ros_output import CalibratedFrames

AXIS = AxisReply(status="not_accepted", sigma=None, correction=0.0, unit="deg")
POSE = se3.perturb(np.eye(4), np.array([0.3, -0.2, 0.1, 1.0, 2.0, 3.0]))


def served(
    provenance: Provenance, pair: str = "front", camera: str = "camera", lidar: str = "lidar", pose: se3.Array = POSE
) -> ExtrinsicReply:
    return ExtrinsicReply(
        vehicle="shuttle-7",
        pair=pair,
        camera_frame=camera,
        lidar_frame=lidar,
        camera_from_lidar=transform_of(pose),
        provenance=provenance,
        status="accepted",
        percent_complete=0.0,
        axes=Axes(rx=AXIS, ry=AXIS, rz=AXIS, tx=AXIS, ty=AXIS, tz=AXIS),
        valid_from_ns=0,
        data_stamp_ns=None,
        window_id=None,
        config_hash="0",
    )


def frames(ros: RosConfig | None = None) -> CalibratedFrames:
    return CalibratedFrames(ros or RosConfig())


@pytest.mark.parametrize("provenance", ["commissioned", "estimated", "restored"])
def test_the_camera_is_a_child_of_the_lidar_at_the_inverse_of_what_is_served(provenance: Provenance) -> None:
    reported = frames().transforms([served(provenance)])

    (placed,) = reported.placed
    assert (placed.parent, placed.child) == ("lidar", "camera_calibrated")
    assert np.allclose(placed.T_parent_child @ POSE, np.eye(4), atol=1e-15)
    assert reported.texts == {"front": f"camera_calibrated in lidar, {provenance}"}


def test_nothing_is_called_calibrated_while_it_is_nominal() -> None:
    reported = frames().transforms([served("nominal")])

    assert reported.placed == ()
    assert reported.texts == {"front": "not published: nominal still"}


def test_after_a_reset_whoever_received_of_the_frame_receives_what_is_served_now() -> None:
    own = frames()
    own.transforms([served("estimated")])

    (placed,) = own.transforms([served("nominal", pose=np.eye(4))]).placed

    assert np.array_equal(placed.T_parent_child, np.eye(4))


def test_the_cameras_own_frame_is_replaced_only_where_that_is_requested_and_then_always() -> None:
    reported = frames(RosConfig(replace_camera_frames=True)).transforms([served("nominal")])

    assert [(placed.parent, placed.child) for placed in reported.placed] == [("lidar", "camera")]


def test_a_camera_of_two_pairs_has_a_calibrated_frame_for_each_and_none_of_its_own() -> None:
    pairs = [served("estimated", "front-top", lidar="top"), served("estimated", "2nd", lidar="bumper")]

    neighbour = frames().transforms(pairs)
    replacing = frames(RosConfig(replace_camera_frames=True)).transforms(pairs)

    assert [(placed.parent, placed.child) for placed in neighbour.placed] == [
        ("top", "camera_front_top_calibrated"),
        ("bumper", "camera__2nd_calibrated"),
    ]
    assert replacing.placed == ()
    assert set(replacing.texts.values()) == {
        "not published: camera is the camera of several pairs, and a frame has one parent"
    }


def test_frames_are_named_as_tf2_has_them() -> None:
    (placed,) = frames().transforms([served("estimated", camera="/camera", lidar="/lidar")]).placed

    assert (placed.parent, placed.child) == ("lidar", "camera_calibrated")


def test_no_frame_is_its_own_parent() -> None:
    reported = frames(RosConfig(calibrated_suffix="_lidar")).transforms([served("estimated", lidar="camera_lidar")])

    assert reported.placed == ()
