"""Keys, tokens and attachments against bytes written by hand: those of rmw_zenoh as they were on the wire between
rmw_zenoh_cpp 0.6.7 and a session, those of the bridge after its source."""

from __future__ import annotations

import pytest

from coec.io.ros import messages
from coec.io.ros.wire_format import SENSOR_DATA, STATIC, Dialect, Node, Qos, RmwZenoh, Ros2dds, gid_of, qos_text

SESSION = "b0a1c2d3e4f5061728394a5b6c7d8e9f"
RMW = RmwZenoh(Node(0, SESSION, 0, "/vehicle", "coec"), messages.type_hash)
BRIDGE = Ros2dds(SESSION, "")
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
TF_TOKEN = (
    f"@ros2_lv/0/{SESSION}/0/3/MP/%/%vehicle/coec/%tf_static/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}/:1:,1:,:,:,,"
)


def test_a_session_is_a_node_of_rmw_zenoh_and_none_of_the_bridge() -> None:
    dialects: list[Dialect] = [RMW, BRIDGE]

    assert [dialect.node_token for dialect in dialects] == [
        f"@ros2_lv/0/{SESSION}/0/0/NN/%/%vehicle/coec",
        None,
    ]


def test_the_key_of_tf_static_is_the_one_on_the_wire() -> None:
    assert RMW.key("/tf_static", messages.TF) == f"0/tf_static/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}"
    assert BRIDGE.key("/tf_static", messages.TF) == "tf_static"
    assert Ros2dds(SESSION, "/shuttle").key("/tf_static", messages.TF) == "shuttle/tf_static"


def test_the_token_of_a_publisher_is_the_one_on_the_wire() -> None:
    assert RMW.publisher_token(3, "/tf_static", messages.TF, STATIC) == TF_TOKEN
    assert (
        Ros2dds(SESSION, "/shuttle").publisher_token(3, "/tf_static", messages.TF, STATIC)
        == f"@/{SESSION}/@ros2_lv/MP/shuttle§tf_static/tf2_msgs§msg§TFMessage/:1:1:0,1"
    )


def test_the_attachment_is_number_stamp_length_and_gid() -> None:
    assert RMW.attachment(TF_TOKEN, 1, 1_700_000_000_123_456_789) == bytes.fromhex(
        "0100000000000000 15cd853dfe9c9717 10 a759ade3098f98699b6b54e6c54bae0d"
    )
    assert BRIDGE.attachment(TF_TOKEN, 1, 1_700_000_000_123_456_789) is None


def test_a_gid_is_the_hash_of_the_token_low_byte_first() -> None:
    """The empty text's is among the test vectors of XXH3 (128 bits, seed 0)."""
    assert gid_of("") == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1]


@pytest.mark.parametrize(
    ("qos", "rmw", "bridge"),
    [
        (STATIC, ":1:,1:,:,:,,", ":1:1:0,1"),
        (SENSOR_DATA, "2::,5:,:,:,,", ":0:0:0,5"),
        (Qos(depth=10), "::,10:,:,:,,", ":1:0:0,10"),
        (Qos(), "::,:,:,:,,", ":1:0:0,42"),
    ],
)
def test_quality_of_service_is_reported_as_each_reports_it(qos: Qos, rmw: str, bridge: str) -> None:
    assert qos.text == rmw
    assert qos_text(qos) == bridge
