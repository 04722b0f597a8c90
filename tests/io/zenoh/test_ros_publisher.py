"""Publishers of ROS topics through an embedded router, as another session sees them."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from coec.config import LimitsConfig, RosConfig, ZenohConfig
from coec.io.ros.messages import TF
from coec.io.ros.wire_format import STATIC, Dialect, MessageAttachment, Node, Qos, RmwZenoh, Ros2dds, gid_of
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.ros_node import RosNode, RosPublishers, dialect_of
from support.fake_worker import wait_until
from support.router import free_port
from support.vehicles import pair_configuration

TIMEOUT_S = 20.0
STRING = "std_msgs/msg/String"
KEY = "0/chatter/std_msgs::msg::dds_::String_/RIHS01_00"
RELIABLE = Qos(depth=10)
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def session(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        yield session


@pytest.fixture
def client(endpoint: str, session: zenoh.Session) -> Iterator[zenoh.Session]:
    del session  # the router has to be there first
    with open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as client:
        yield client


def rmw_of(session: zenoh.Session) -> RmwZenoh:
    return RmwZenoh(Node(0, str(session.info.zid()), 0, "/shuttle", "coec"), lambda _: "RIHS01_00")


def publishers_of(session: zenoh.Session, dialect: Dialect) -> RosPublishers:
    return RosPublishers(session, RosNode(session, dialect))


def tokens(client: zenoh.Session, expression: str) -> set[str]:
    replies = list(client.liveliness().get(expression, timeout=TIMEOUT_S))
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def received(subscriber: zenoh.Subscriber[queue.Queue[zenoh.Sample]]) -> zenoh.Sample:
    return subscriber.handler.get(timeout=TIMEOUT_S)


def queued() -> tuple[zenoh.handlers.Callback[zenoh.Sample], queue.Queue[zenoh.Sample]]:
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    return zenoh.handlers.Callback(samples.put, indirect=False), samples


def test_messages_are_numbered_from_one_and_name_the_publisher_by_its_token(
    session: zenoh.Session, client: zenoh.Session
) -> None:
    publishers = publishers_of(session, rmw_of(session))
    publisher = publishers.publisher("/chatter", STRING, RELIABLE)
    subscriber = client.declare_subscriber(KEY, queued())
    wait_until(lambda: publisher.has_subscribers, "somebody who listens", TIMEOUT_S)

    for index in range(3):
        publisher.put(b"\0\1\0\0" + bytes([index]), 1_000 + index)

    samples = [received(subscriber) for _ in range(3)]
    token = f"@ros2_lv/0/{session.info.zid()}/0/1/MP/%/%shuttle/coec/%chatter/std_msgs::msg::dds_::String_/RIHS01_00"
    gid = gid_of(f"{token}/::,10:,:,:,,")
    assert [MessageAttachment.parse(s.attachment.to_bytes()) for s in samples if s.attachment is not None] == [
        MessageAttachment(1, 1000, gid),
        MessageAttachment(2, 1001, gid),
        MessageAttachment(3, 1002, gid),
    ]
    assert {str(sample.encoding) for sample in samples} == {"zenoh/bytes"}
    assert [sample.payload.to_bytes()[-1] for sample in samples] == [0, 1, 2]
    assert {str(sample.key_expr) for sample in samples} == {KEY} == {publisher.key}


def test_a_node_and_its_publishers_are_listed_until_they_close(session: zenoh.Session, client: zenoh.Session) -> None:
    node = RosNode(session, rmw_of(session))
    publishers = RosPublishers(session, node)
    publishers.publisher("/chatter", STRING, RELIABLE)
    publishers.publisher("/tf_static", STRING, STATIC)
    own = f"@ros2_lv/0/{session.info.zid()}/0"
    wait_until(lambda: len(tokens(client, "@ros2_lv/0/**")) == 3, "all tokens", TIMEOUT_S)

    assert {token.split("/%/")[0] for token in tokens(client, "@ros2_lv/0/**")} == {
        f"{own}/0/NN",
        f"{own}/1/MP",
        f"{own}/2/MP",
    }

    publishers.close()
    wait_until(lambda: len(tokens(client, "@ros2_lv/0/**")) == 1, "the publishers gone", TIMEOUT_S)
    node.close()
    wait_until(lambda: not tokens(client, "@ros2_lv/0/**"), "the node gone", TIMEOUT_S)


def test_whoever_comes_later_gets_the_last_message_of_a_latched_topic(
    session: zenoh.Session, client: zenoh.Session
) -> None:
    publishers = publishers_of(session, rmw_of(session))
    latched = publishers.publisher("/tf_static", STRING, STATIC)
    latched.put(b"first", 1)
    latched.put(b"second", 2)

    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    late = declare_advanced_subscriber(
        client,
        "0/tf_static/*/*",
        zenoh.handlers.Callback(samples.put, indirect=False),
        history=HistoryConfig(detect_late_publishers=True, max_samples=100),
        recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
        subscriber_detection=True,
    )

    sample = samples.get(timeout=TIMEOUT_S)
    assert sample.payload.to_bytes() == b"second"
    assert sample.attachment is not None
    assert (reported := MessageAttachment.parse(sample.attachment.to_bytes())) is not None
    assert reported.sequence == 2
    late.undeclare()


def test_nobody_listens_to_a_topic_that_nobody_subscribes_to(session: zenoh.Session) -> None:
    publishers = publishers_of(session, rmw_of(session))

    assert not publishers.publisher("/chatter", STRING, RELIABLE).has_subscribers
    assert publishers.publisher("/tf_static", STRING, STATIC).has_subscribers


def test_next_to_a_bridge_messages_go_bare_on_plain_keys(session: zenoh.Session, client: zenoh.Session) -> None:
    publishers = publishers_of(session, Ros2dds(str(session.info.zid()), ""))
    publisher = publishers.publisher("/chatter", STRING, RELIABLE)
    subscriber = client.declare_subscriber("chatter", queued())
    wait_until(lambda: publisher.has_subscribers, "somebody who listens", TIMEOUT_S)

    publisher.put(b"hello", 1)

    sample = received(subscriber)
    assert sample.payload.to_bytes() == b"hello"
    assert sample.attachment is None
    wait_until(
        lambda: (
            tokens(client, "@/*/@ros2_lv/**")
            == {f"@/{session.info.zid()}/@ros2_lv/MP/chatter/std_msgs§msg§String/:1:0:0,10"}
        ),
        "the token",
        TIMEOUT_S,
    )


@pytest.mark.parametrize(
    ("middleware", "ros", "key", "token"),
    [
        (
            "rmw_zenoh",
            RosConfig(domain=7),
            f"7/tf_static/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}",
            f"@ros2_lv/7/ZID/0/1/MP/%/%shuttle_7/coec/%tf_static/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}/:1:,1:,:,:,,",
        ),
        (
            "ros2dds",
            RosConfig(namespace="/fleet/seven"),
            "fleet/seven/tf_static",
            "@/ZID/@ros2_lv/MP/fleet§seven§tf_static/tf2_msgs§msg§TFMessage/:1:1:0,1",
        ),
    ],
)
def test_a_service_publishes_as_its_configuration_says(
    session: zenoh.Session,
    client: zenoh.Session,
    middleware: Literal["rmw_zenoh", "ros2dds"],
    ros: RosConfig,
    key: str,
    token: str,
) -> None:
    native = pair_configuration(Path("state"), vehicle="shuttle-7")
    config = native.model_copy(update={"middleware": middleware, "ros": ros})
    dialect = dialect_of(config, str(session.info.zid()))
    assert dialect is not None
    publishers = publishers_of(session, dialect)

    assert publishers.publisher("/tf_static", TF, STATIC).key == key
    expected = token.replace("ZID", str(session.info.zid()))
    wait_until(lambda: tokens(client, expected) == {expected}, "the token", TIMEOUT_S)


def test_a_session_that_starts_anew_is_another_publisher() -> None:
    topic = ("/chatter", STRING, RELIABLE)
    first, second = (RmwZenoh(Node(0, zid, 0, "/shuttle", "coec"), lambda _: "RIHS01_00") for zid in ("aa", "bb"))

    assert gid_of(first.publisher_token(1, *topic)) != gid_of(second.publisher_token(1, *topic))
