"""Keys, tokens and attachments that anybody may put on the network: read, or said to be none; never more."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from coec.errors import UsageError
from coec.io.ros import wire_format
from coec.io.ros.wire_format import MessageAttachment, Publisher, TopicKey

SESSION = "aa0ba1fb1b3a2e2c9d8f5e6c3b4a5d6e"
TOKEN = (
    f"@ros2_lv/0/{SESSION}/0/10/MP/%/%sensing/driver/%front%image/sensor_msgs::msg::dds_::Image_/RIHS01_00/2::,5:,:,:,,"
)
BRIDGED = f"@/{SESSION}/@ros2_lv/MP/front§image/sensor_msgs§msg§Image/:0:0:0,5"
KEY = "0/front/image/sensor_msgs::msg::dds_::Image_/RIHS01_00"

READERS: dict[str, tuple[str, Callable[[str], Publisher | None]]] = {
    "rmw_zenoh": (TOKEN, wire_format.rmw_publisher),
    "ros2dds": (BRIDGED, lambda token: wire_format.bridge_publisher(token, "")),
}

hostile = st.text(max_size=60) | st.sampled_from(["", "%", "§", "/", "::", "@", "*", "**", "\0", "\x1b[2J", "a" * 5000])


def mutated(text: str) -> st.SearchStrategy[str]:
    """The text with one piece put in place of another."""
    at = st.integers(0, len(text))
    return st.tuples(at, at, hostile).map(lambda cut: text[: min(cut[:2])] + cut[2] + text[max(cut[:2]) :])


@pytest.mark.fault(
    "keys, tokens and attachments mutated at will", "they are read, or called invalid; nothing else is raised"
)
@pytest.mark.parametrize("middleware", READERS)
@given(st.data())
def test_a_token_is_a_publishers_with_names_that_ros_takes_or_none(middleware: str, data: st.DataObject) -> None:
    valid, read = READERS[middleware]
    assert read(valid) is not None
    result = read(data.draw(mutated(valid)))
    if result is not None:
        names = result.topic + result.type_name + (result.node or "")
        assert all(char.isascii() and (char.isalnum() or char in "_/") for char in names)
        assert len(result.topic) < wire_format.MAX_RMW_TOKEN


@given(mutated(KEY))
def test_a_key_is_a_topics_or_reported_to_be_none(key: str) -> None:
    try:
        result = TopicKey.parse(key)
    except UsageError:
        return
    assert 0 <= result.domain <= 999
    assert result.type_name.count("/") == 2


@given(st.binary(max_size=80))
@example(b"\xff" * 33)
@example(b"")
def test_an_attachment_is_one_or_none(attachment: bytes) -> None:
    result = MessageAttachment.parse(attachment)
    if result is not None:
        assert result.packed == attachment
        assert result.sequence >= 0
