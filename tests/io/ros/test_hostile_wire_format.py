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
    found = read(data.draw(mutated(valid)))
    if found is not None:
        names = found.topic + found.type_name + (found.node or "")
        assert all(char.isascii() and (char.isalnum() or char in "_/") for char in names)
        assert len(found.topic) < wire_format.MAX_RMW_TOKEN


@given(mutated(KEY))
def test_a_key_is_a_topics_or_said_to_be_none(key: str) -> None:
    try:
        found = TopicKey.parse(key)
    except UsageError:
        return
    assert 0 <= found.domain <= 999
    assert found.type_name.count("/") == 2


@given(st.binary(max_size=80))
@example(b"\xff" * 33)
@example(b"")
def test_an_attachment_is_one_or_none(attachment: bytes) -> None:
    found = MessageAttachment.parse(attachment)
    if found is not None:
        assert found.packed == attachment
        assert found.sequence >= 0
