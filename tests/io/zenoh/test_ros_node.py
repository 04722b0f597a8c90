"""The service as a node of ROS, and what it sees of the others, against tokens written by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from coec.config import Config, LimitsConfig, OpenLidarConfig, ZenohConfig
from coec.io.ros.messages import OUSTER_PACKETS, STRING
from coec.io.ros.wire_format import Qos
from coec.io.zenoh import ros_node
from coec.io.zenoh.bus import Bus, open_session
from coec.io.zenoh.ros_node import RosPublishers, RosSide, RosTopicList, listed
from coec.schemas.keys import ros_name
from support.fake_worker import wait_until
from support.router import free_port

OTHER = "aa0ba1fb1b3a2e2c9d8f5e6c3b4a5d6e"
IMAGE_HASH = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
DRIVER = (
    f"@ros2_lv/0/{OTHER}/0/10/MP/%/%sensing/camera_driver/%front%image_raw/"
    f"sensor_msgs::msg::dds_::Image_/{IMAGE_HASH}/2::,5:,:,:,,"
)
POINTS = DRIVER.replace("/10/", "/11/").replace("%front%image_raw", "%top%points").replace("Image_", "PointCloud2_")
BRIDGE = f"@/{OTHER}/@ros2_lv/MP/shuttle§front§image_raw/sensor_msgs§msg§Image/:0:0:0,5"
TIMEOUT_S = 20.0


def configured(middleware: str, vehicle: str = "vehicle", **ros: object) -> Config:
    pair = {
        "name": "front",
        "camera": {
            "topic": "/front/image_raw",
            "intrinsics": {"model": "pinhole", "width": 8, "height": 6, "fx": 4, "fy": 4, "cx": 4, "cy": 3},
        },
        "points": "/top/points",
        "ego": {"key": "ego"},
        "T_camera_lidar": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }
    return Config.model_validate({"vehicle": vehicle, "middleware": middleware, "ros": ros, "pairs": [pair]})


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def session(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        yield session


@pytest.fixture
def side(session: zenoh.Session, stack: ExitStack) -> RosSide:
    side = RosSide(session, configured("rmw_zenoh"))
    stack.callback(side.close)
    return side


def seen(session: zenoh.Session, expression: str) -> set[str]:
    replies = list(session.liveliness().get(expression, timeout=TIMEOUT_S))
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def test_the_service_shows_itself_as_a_node_that_subscribes(session: zenoh.Session, side: RosSide) -> None:
    bus, own = Bus(session), str(session.info.zid())
    for stream in configured("rmw_zenoh").every_pair[0].streams.values():
        bus.subscribe(side.input_of(stream), lambda _: None)
    points = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    node, described = f"@ros2_lv/0/{own}/0", "2::,5:,:,:,,/backends:cpu:"
    assert seen(session, "@ros2_lv/**") == {
        f"{node}/0/NN/%/%vehicle/coec",
        f"{node}/1/MS/%/%vehicle/coec/%front%image_raw/sensor_msgs::msg::dds_::Image_/{IMAGE_HASH}/{described}",
        f"{node}/2/MS/%/%vehicle/coec/%top%points/sensor_msgs::msg::dds_::PointCloud2_/{points}/{described}",
    }
    bus.undeclare_inputs()
    side.close()
    assert seen(session, "@ros2_lv/**") == set()


def test_the_service_shows_that_it_listens_to_transforms_and_camera_info(session: zenoh.Session, side: RosSide) -> None:
    bus, own = Bus(session), str(session.info.zid())
    for stream in (side.input_of_static_transforms(), side.input_of_info("/front/camera_info")):
        bus.subscribe_latched(stream, lambda _: None)
    tf = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    info = "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275"
    shown = f"@ros2_lv/0/{own}/0"
    assert seen(session, "@ros2_lv/*/*/*/*/MS/**") == {
        f"{shown}/1/MS/%/%vehicle/coec/%tf_static/tf2_msgs::msg::dds_::TFMessage_/{tf}/:1:,100:,:,:,,/backends:cpu:",
        f"{shown}/2/MS/%/%vehicle/coec/%front%camera_info/sensor_msgs::msg::dds_::CameraInfo_/{info}/2::,5:,:,:,,"
        "/backends:cpu:",
    }
    bus.undeclare_inputs()
    assert seen(session, "@ros2_lv/*/*/*/*/MS/**") == set()


@pytest.mark.parametrize("middleware", ["native", "ros2dds"])
def test_elsewhere_subscribing_is_enough(session: zenoh.Session, stack: ExitStack, middleware: str) -> None:
    config = configured("ros2dds")
    side = RosSide(session, config.model_copy(update={"middleware": middleware}))
    stack.callback(side.close)
    assert [side.input_of(stream).token for stream in config.every_pair[0].streams.values()] == [None] * 3
    assert side.topics() == RosTopicList()


@pytest.mark.parametrize(
    ("vehicle", "namespace"), [("shuttle-7", "/shuttle_7"), ("7.up", "/_7_up"), ("bus_1", "/bus_1")]
)
def test_a_vehicle_has_a_name_that_ros_takes(vehicle: str, namespace: str) -> None:
    assert f"/{ros_name(vehicle)}" == namespace


def test_publishers_are_seen_with_type_and_node_while_they_are_there(
    session: zenoh.Session, side: RosSide, endpoint: str
) -> None:
    with open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as driver:
        tokens = [driver.liveliness().declare_token(token) for token in (DRIVER, POINTS)]
        wait_until(lambda: len(side.topics().publishers) == 2, "both are seen")
        topics = side.topics()
        assert topics.types() == {
            "/front/image_raw": ("sensor_msgs/msg/Image",),
            "/top/points": ("sensor_msgs/msg/PointCloud2",),
        }
        (publisher,) = topics.of("/front/image_raw")
        assert publisher.node == "/sensing/camera_driver"
        assert topics.nodes_of([publisher.gid or b"", bytes(16)]) == ("/sensing/camera_driver",)
        late = RosSide(session, configured("rmw_zenoh"))
        wait_until(lambda: len(late.topics().publishers) == 2, "who comes later sees them, too")
        late.close()
        for token in tokens:
            token.undeclare()
        wait_until(lambda: side.topics() == RosTopicList(), "they are gone")


def test_a_bridges_publishers_are_seen_in_its_namespace(session: zenoh.Session, stack: ExitStack) -> None:
    token = session.liveliness().declare_token(BRIDGE)
    stack.callback(token.undeclare)
    inside, context = (RosSide(session, configured("ros2dds", namespace=name)) for name in ("/shuttle", "/shut"))
    for side in (inside, context):
        stack.callback(side.close)
    wait_until(lambda: bool(context.topics().left_out), "it is seen")
    assert inside.topics().types() == {"/front/image_raw": ("sensor_msgs/msg/Image",)}
    assert context.topics().publishers == ()


@pytest.mark.fault("liveliness tokens that no node of ROS would declare", "ignored and counted")
@pytest.mark.parametrize(
    "token",
    [
        DRIVER.replace("Image_", "Image"),
        DRIVER.replace("%front", "front"),
        DRIVER.replace("image_raw", "image\x1b[31mraw"),
        DRIVER.replace("camera_driver", "[bold]x"),
        DRIVER.replace("image_raw", "a" * 2000),
        f"@ros2_lv/0/{OTHER}/0/10/MP/x",
    ],
)
def test_a_token_that_reports_of_no_publisher_is_counted(session: zenoh.Session, side: RosSide, token: str) -> None:
    declared = session.liveliness().declare_token(token)
    wait_until(lambda: bool(side.topics().left_out), "it is seen")
    assert side.topics() == RosTopicList((), Counter(malformed=1))
    declared.undeclare()


@pytest.mark.fault("a flood of liveliness tokens", "as many are kept as a vehicle can have, the others counted")
def test_of_too_many_tokens_the_first_are_retained(
    session: zenoh.Session, side: RosSide, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_node, "MAX_PUBLISHERS", 100)
    for number in range(300):
        declared = session.liveliness().declare_token(DRIVER.replace("/10/", f"/{number}/"))
        stack.callback(declared.undeclare)
    wait_until(lambda: side.topics().left_out["too_many"] == 200, "all of them are seen")
    assert len(side.topics().publishers) == 100


def test_what_a_service_says_itself_is_no_topic_of_the_vehicles(session: zenoh.Session, side: RosSide) -> None:
    own = session.liveliness().declare_token(DRIVER.replace("%front%image_raw", "%coec%front%overlay"))
    token = session.liveliness().declare_token(DRIVER)
    wait_until(lambda: bool(side.topics().publishers), "it is seen")
    assert list(side.topics().types()) == ["/front/image_raw"]
    assert not side.topics().left_out
    for declared in (own, token):
        declared.undeclare()


def test_who_is_missing_is_reported_with_those_who_are_there(session: zenoh.Session, side: RosSide) -> None:
    token = session.liveliness().declare_token(DRIVER)
    wait_until(lambda: bool(side.topics().publishers), "it is seen")
    topics = side.topics()
    images = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
    assert topics.absent("/front/image_raw", images) is None
    assert topics.absent("/rear", images) == "no publisher of /rear; there are: /front/image_raw"
    assert topics.absent("/top", ("sensor_msgs/msg/PointCloud2",)) == (
        "no publisher of /top; of 1 topics that are there none is of type PointCloud2"
    )
    token.undeclare()


def test_a_sentence_names_a_few() -> None:
    assert listed([f"/{number}" for number in range(3)]) == "/0, /1, /2"
    assert listed([f"/{number}" for number in range(30)]) == "/0, /1, /2, /3, /4, /5, /6, /7 and 22 more"


def test_metadata_that_were_published_before_come_with_the_packets_of_their_lidar(
    session: zenoh.Session, side: RosSide, endpoint: str
) -> None:
    lidar = OpenLidarConfig(topic="/ouster/lidar_packets")
    with ExitStack() as stack:
        driver = stack.enter_context(open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()))
        node = RosSide(driver, configured("rmw_zenoh", "driver"))
        stack.callback(node.close)
        assert node.node is not None
        publishers = RosPublishers(driver, node.node)
        stack.callback(publishers.close)
        publishers.publisher("/ouster/metadata", STRING, Qos(transient_local=True, depth=1)).put(b"metadata", 1)
        packets = publishers.publisher("/ouster/lidar_packets", OUSTER_PACKETS[0], Qos(depth=1))
        received: list[tuple[bytes, str]] = []
        bus = Bus(session)
        end = bus.subscribe(side.input_of(lidar), lambda sample: received.append((sample.payload, sample.encoding)))

        def all_received() -> bool:
            packets.put(b"packet", 1)
            return len(set(received)) == 2

        wait_until(all_received, "both are received")
        assert set(received) == {
            (b"metadata", "application/cdr;std_msgs/msg/String"),
            (b"packet", f"application/cdr;{OUSTER_PACKETS[0]}"),
        }
        end()
