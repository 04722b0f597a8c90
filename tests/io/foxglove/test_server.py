"""The WebSocket, by a real client: what comes out of it is what was shown, to the pixel."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import psutil
import pytest

pytest.importorskip("foxglove", reason="needs the optional extra `foxglove`")

from coec.calibration.types import Rig
from coec.config import LimitsConfig
from coec.errors import UnavailableError
from coec.geometry import se3
from coec.geometry.cameras import build
from coec.geometry.projection import project
from coec.io import viewer_scene
from coec.io.foxglove import ViewerServer
from coec.io.images import encode_png, probe
from coec.io.viewer_scene import (
    PICTURE_TOPICS,
    POINTS_TOPICS,
    TOPIC_DESCRIPTIONS,
    DisplayedPose,
    PairPicture,
    picture_of,
    timeline_schema,
    topics_for,
    viewer_camera,
)
from support.fake_worker import wait_until
from support.readers import BINARY, TEXT, Viewer
from support.scenes import BOARD_LENSES, BOARD_MOVED, BOARD_NOMINAL, board_frame_pair, board_rig, board_sweep
from support.viewer import EXTRINSICS, FULL, places, projected

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

HOST = "127.0.0.1"
NOISY_BYTES = 700_000
PICTURES_SENT = 250
RETAINED_MB = 90.0
"""What may be kept for a viewer who reads nothing, of some 190 MB that were shown: 32 messages, and what the allocator
and the kernel hold of them."""


@pytest.fixture
def screen() -> Iterator[ViewerServer]:
    screen = ViewerServer(HOST, 0, "coec test", BOARD_LENSES["kannala_brandt"])
    yield screen
    screen.close()


def picture(lens: str = "double_sphere") -> tuple[PairPicture, Rig]:
    rig = board_rig(BOARD_LENSES[lens])
    pair = replace(
        board_frame_pair(rig.camera), lidar=replace(board_sweep(), xyz_m=board_sweep().xyz_m[::16], ring=None)
    )
    return picture_of(pair, rig, EXTRINSICS, PICTURE_TOPICS, LimitsConfig(), compensated=True), rig


def shown_to(viewer: Viewer, screen: ViewerServer, picture: PairPicture, *expected: str) -> None:
    """Subscribe, and show it as soon as that is known."""
    viewer.subscribe(expected)
    wait_until(lambda: set(expected) <= screen.requested_topics, f"subscriptions to {', '.join(expected)}")
    screen.send_picture(picture)


def test_pixels_arrive_as_the_projection_puts_them(screen: ViewerServer) -> None:
    reported, rig = picture()
    with Viewer(screen.url) as viewer:
        shown_to(viewer, screen, reported, *POINTS_TOPICS.values())
        for pose, T_camera_lidar in ((DisplayedPose.SERVED, BOARD_MOVED), (DisplayedPose.NOMINAL, BOARD_NOMINAL)):
            message = viewer.next_on(POINTS_TOPICS[pose])
            assert viewer.channels[POINTS_TOPICS[pose]]["schemaName"] == "foxglove.ImageAnnotations"
            assert {band.type for band in message.points} == {1}, "points, not lines"
            assert {stamp_ns(band) for band in [message, *message.points, *message.texts]} == {reported.stamp_ns}
            # Viewers count from the corner of the first pixel, which is not where its centre is.
            received = np.array([(point.x - 0.5, point.y - 0.5) for band in message.points for point in band.points])
            assert places(received) == places(projected(rig.camera, T_camera_lidar, board_sweep().xyz_m[::16]))
            assert [text.text for text in message.texts] == [EXTRINSICS[pose].title]
        nothing = viewer.next_on(POINTS_TOPICS[DisplayedPose.CANDIDATE])
        assert ([text.text for text in nothing.texts], len(nothing.points)) == (["none"], 0)
        assert stamp_ns(nothing.texts[0]) == reported.stamp_ns, "who synchronises waits for it"


def stamp_ns(message: object) -> int:
    timestamp = message.timestamp  # type: ignore[attr-defined]  # of a schema that came over the wire
    return int(timestamp.seconds * 10**9 + timestamp.nanos)


def test_image_cloud_frames_and_intrinsics_arrive_as_they_are(screen: ViewerServer) -> None:
    reported, rig = picture("kannala_brandt")
    assert reported.image is not None
    assert reported.cloud is not None
    with Viewer(screen.url) as viewer:
        shown_to(
            viewer,
            screen,
            reported,
            viewer_scene.IMAGE_TOPIC,
            viewer_scene.CLOUD_TOPIC,
            viewer_scene.TRANSFORMS_TOPIC,
            viewer_scene.CALIBRATION_TOPIC,
        )
        image = viewer.next_on(viewer_scene.IMAGE_TOPIC)
        assert (image.format, image.data, image.frame_id) == ("jpeg", reported.image.data, "cam_served")
        cloud = viewer.next_on(viewer_scene.CLOUD_TOPIC)
        assert [(field.name, field.offset, field.type) for field in cloud.fields] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("range", 12, 7),
        ]  # fmt: skip
        assert (cloud.frame_id, cloud.point_stride) == ("velo", 16)
        np.testing.assert_array_equal(np.frombuffer(cloud.data, "<f4").reshape(-1, 4), reported.cloud)
        transforms = viewer.next_on(viewer_scene.TRANSFORMS_TOPIC).transforms
        assert [(one.parent_frame_id, one.child_frame_id) for one in transforms] == [
            ("velo", "cam_served"), ("velo", "cam_nominal"),
        ]  # fmt: skip
        for one, T_camera_lidar in zip(transforms, (BOARD_MOVED, BOARD_NOMINAL), strict=True):
            place, turn = one.translation, one.rotation
            R = se3.rotation_from_quaternion_xyzw(np.array([turn.x, turn.y, turn.z, turn.w]))
            T_lidar_camera = se3.transform_from(R, np.array([place.x, place.y, place.z]))
            np.testing.assert_allclose(T_lidar_camera @ T_camera_lidar, np.eye(4), atol=1e-12)
        calibration = viewer.next_on(viewer_scene.CALIBRATION_TOPIC)
        camera = rig.camera
        assert (calibration.distortion_model, calibration.width, calibration.height) == ("kannala_brandt", 640, 400)
        assert list(calibration.K) == [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
        assert len(calibration.D) == 4


def test_intrinsics_of_a_lens_that_viewers_do_not_know_are_those_of_one_that_they_know() -> None:
    """To a hundredth of a pixel all over the image, in OpenCV's fisheye model, which `kannala_brandt` names."""
    reported, rig = picture("double_sphere")
    screen = ViewerServer(HOST, 0, "coec test", rig.camera)
    try:
        with Viewer(screen.url) as viewer:
            shown_to(viewer, screen, reported, viewer_scene.CALIBRATION_TOPIC)
            calibration = viewer.next_on(viewer_scene.CALIBRATION_TOPIC)
    finally:
        screen.close()
    assert calibration.distortion_model == "kannala_brandt"
    points_m = np.random.default_rng(3).uniform([-1.0, -0.6, 0.5], [1.0, 0.6, 3.0], size=(200, 3))
    uv_px, seen = project(rig.camera, points_m)
    still, K = np.zeros(3), np.reshape(calibration.K, (3, 3))
    fitted_px = cv2.fisheye.projectPoints(points_m[:, None], still, still, K, np.array(calibration.D))[0][:, 0]
    np.testing.assert_allclose(fitted_px[seen], uv_px[seen], atol=0.01)


def test_intrinsics_that_viewers_cannot_have_are_no_topic() -> None:
    """Who subscribed to one would wait for ever."""
    reported, rig = picture("double_sphere")
    odd = build(
        "mei", width=640, height=400, fx=150.0, fy=150.0, cx=320.0, cy=200.0, xi=1.0, k1=4.0, k2=-9.0, p1=0.2, p2=0.0
    )
    assert viewer_camera(odd) is None
    screen = ViewerServer(HOST, 0, "coec test", odd)
    try:
        with Viewer(screen.url) as viewer:
            shown_to(viewer, screen, replace(reported, rig=replace(rig, camera=odd)), viewer_scene.IMAGE_TOPIC)
            viewer.next_on(viewer_scene.IMAGE_TOPIC)
            assert (
                set(viewer.channels)
                == set(topics_for(odd))
                == set(TOPIC_DESCRIPTIONS) - {viewer_scene.CALIBRATION_TOPIC}
            )
    finally:
        screen.close()


def test_the_timeline_arrives_with_its_schema_and_remarks_with_their_level(screen: ViewerServer) -> None:
    with Viewer(screen.url) as viewer:
        viewer.subscribe([viewer_scene.HEALTH_TOPIC, viewer_scene.LOG_TOPIC])
        wait_until(lambda: len(screen.requested_topics) == 2, "subscriptions")
        screen.send_entry(FULL)
        screen.send_log(2, "It has moved.", "front")
        assert viewer.next_on(viewer_scene.HEALTH_TOPIC) == FULL.document()
        channel = viewer.channels[viewer_scene.HEALTH_TOPIC]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        assert json.loads(channel["schema"]) == timeline_schema()
        comment = viewer.next_on(viewer_scene.LOG_TOPIC)
        assert (comment.message, comment.name, comment.level) == ("It has moved.", "front", 4)
        assert set(viewer.channels) == set(TOPIC_DESCRIPTIONS)
        assert viewer.info["capabilities"] == [], "viewers change nothing"


def test_what_nobody_checks_is_known(screen: ViewerServer) -> None:
    assert screen.requested_topics == frozenset()
    with Viewer(screen.url) as viewer:
        viewer.subscribe([viewer_scene.IMAGE_TOPIC])
        wait_until(lambda: screen.requested_topics == {viewer_scene.IMAGE_TOPIC}, "one subscription")
    wait_until(lambda: screen.requested_topics == frozenset(), "its end with the viewer's")


def test_a_port_that_is_taken_is_reported_and_may_be_free_later(screen: ViewerServer) -> None:
    port = int(screen.url.rpartition(":")[2])
    with pytest.raises(UnavailableError, match=f"{HOST}:{port}: Address already in use"):
        ViewerServer(HOST, port, "another", BOARD_LENSES["pinhole"])


def test_an_address_of_the_sixth_version_is_written_in_brackets() -> None:
    screen = ViewerServer("::1", 0, "coec test", BOARD_LENSES["pinhole"])
    try:
        assert screen.url.startswith("ws://[::1]:")
    finally:
        screen.close()


@pytest.mark.fault(
    "a viewer who reads nothing",
    "others see everything at once; what is kept for that viewer is bounded",
)
def test_who_does_not_read_costs_nothing(screen: ViewerServer, record_property: Record) -> None:
    reported, _ = picture()
    noise = np.frombuffer(np.random.default_rng(1).bytes(640 * 400 * 3), np.uint8).reshape(400, 640, 3)
    large = replace(reported, image=probe(encode_png(noise), LimitsConfig()), marks={}, cloud=None)
    assert large.image is not None
    assert len(large.image.data) > NOISY_BYTES
    process = psutil.Process(os.getpid())
    with Viewer(screen.url) as deaf, Viewer(screen.url) as other:
        deaf.subscribe([viewer_scene.IMAGE_TOPIC])
        wait_until(lambda: viewer_scene.IMAGE_TOPIC in screen.requested_topics, "his subscription")
        other.subscribe([viewer_scene.IMAGE_TOPIC, viewer_scene.HEALTH_TOPIC])
        wait_until(lambda: viewer_scene.HEALTH_TOPIC in screen.requested_topics, "the other's")
        before = process.memory_info().rss
        for number in range(PICTURES_SENT):
            screen.send_picture(replace(large, stamp_ns=number))
            assert stamp_ns(other.next_on(viewer_scene.IMAGE_TOPIC)) == number
        grown_mb = (process.memory_info().rss - before) / 1e6
    assert grown_mb < RETAINED_MB < PICTURES_SENT * NOISY_BYTES / 1e6
    record_property("figure", f"{grown_mb:.0f} MB of {PICTURES_SENT * len(large.image.data) / 1e6:.0f} MB shown")


NONSENSE = (
    b"", b"{", b"[]", b"null", b'{"op":7}', b'{"op":"subscribe"}', b'{"op":"unsubscribe","subscriptionIds":[7,-1]}',
    b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":999999}]}',
    b'{"op":"advertise","channels":[{"id":1,"topic":"/health","encoding":"json","schemaName":"x"}]}',
    b'{"op":"setParameters","parameters":[{"name":"x","value":1}]}', b'{"op":"fetchAsset","uri":"file:///etc/passwd"}',
    b"[" * 100_000, b"\xff" * 1000,
)  # fmt: skip


@pytest.mark.fault("a viewer who talks nonsense", "others see everything, and nothing is changed or handed out")
@pytest.mark.parametrize("code", [TEXT, BINARY])
def test_nonsense_is_of_no_consequence(screen: ViewerServer, code: int) -> None:
    reported, _ = picture()
    with Viewer(screen.url) as other:
        other.subscribe([viewer_scene.IMAGE_TOPIC])
        for nonsense in NONSENSE:
            with Viewer(screen.url) as fool, suppress(OSError):
                fool.send(nonsense, code)
        wait_until(lambda: screen.requested_topics == {viewer_scene.IMAGE_TOPIC}, "the other's subscription")
        screen.send_picture(reported)
        assert stamp_ns(other.next_on(viewer_scene.IMAGE_TOPIC)) == reported.stamp_ns
        assert set(other.channels) == set(TOPIC_DESCRIPTIONS)
