"""The tree of static transforms: ways through it, what contradicts it, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coec.errors import DecodeError
from coec.geometry import se3
from coec.io.ros.transforms import (
    MAX_MESSAGE_BYTES,
    MAX_REFUSED,
    MAX_STATIC_TRANSFORMS,
    StaticTransform,
    StaticTransforms,
    decode_static_transforms,
)
from support.ros import Packer
from support.strategies import twists

T = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))


def packed(*joints: tuple[str, str, tuple[float, ...], tuple[float, ...]], claimed: int | None = None) -> bytes:
    """A `TFMessage` in CDR, by hand: parent, child, translation, quaternion."""
    packer = Packer().put("I", len(joints) if claimed is None else claimed)
    for parent, child, translation, quaternion in joints:
        packer.header(parent).text(child).put("d", *translation, *quaternion)
    return packer.done()


def tree(*joints: tuple[str, str, NDArray[np.float64]]) -> StaticTransforms:
    transforms = StaticTransforms()
    transforms.add(tuple(StaticTransform(parent, child, T_parent_child) for parent, child, T_parent_child in joints))
    return transforms


def test_a_transform_is_the_pose_of_the_child_in_its_parent() -> None:
    half = np.sqrt(0.5)
    (joint,) = decode_static_transforms(packed(("/base", "camera", (1.0, 2.0, 3.0), (0.0, 0.0, half, half)))).joints
    assert (joint.parent, joint.child) == ("base", "camera")
    np.testing.assert_allclose(joint.T_parent_child @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-15)


@given(steps=st.lists(st.tuples(twists(), st.booleans()), min_size=1, max_size=6))
def test_directions_lead_up_and_down_any_number_of_joints(steps: list[tuple[NDArray[np.float64], bool]]) -> None:
    expected = np.eye(4)
    joints = []
    for index, (step, upwards) in enumerate(steps):
        T_here_there = se3.exp(step)
        here, there = f"f{index}", f"f{index + 1}"
        expected = expected @ T_here_there
        joints.append((here, there, T_here_there) if upwards else (there, here, se3.inverse(T_here_there)))
    transforms = tree(*joints)
    result = transforms.transform("f0", f"f{len(steps)}")
    back = transforms.transform(f"/f{len(steps)}", "/f0")
    assert result is not None
    assert back is not None
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result @ back, np.eye(4), rtol=0, atol=1e-9)


def test_frames_that_nothing_connects() -> None:
    transforms = tree(("base", "lidar", T), ("rear", "camera", T))
    assert transforms.transform("camera", "lidar") is None
    assert transforms.transform("camera", "nobody") is None
    assert transforms.frames == ("base", "camera", "lidar", "rear")


def test_what_was_reported_last_holds_and_that_it_changed_is_known() -> None:
    transforms = tree(("base", "lidar", np.eye(4)))
    transforms.add((StaticTransform("base", "lidar", np.eye(4)),))
    assert transforms.replaced == 0
    transforms.add((StaticTransform("base", "lidar", T),))
    assert transforms.replaced == 1
    result = transforms.transform("base", "lidar")
    assert result is not None
    np.testing.assert_array_equal(result, T)


def test_two_parents_are_reported_where_they_lie_on_the_way() -> None:
    transforms = tree(("base", "lidar", T), ("roof", "lidar", T), ("base", "camera", T), ("base", "wheel", T))
    assert transforms.doubts("camera", "lidar") == ("frame 'lidar' has the parents 'base' and 'roof'",)
    assert transforms.doubts("camera", "wheel") == ()


def test_a_loop_is_reported() -> None:
    transforms = tree(("a", "b", T), ("b", "c", T), ("c", "a", T), ("x", "y", T))
    (reported,) = transforms.doubts("a", "c")
    assert reported.endswith("form a loop")
    assert all(repr(frame) in reported for frame in "abc")
    assert transforms.doubts("x", "y") == ()


UNIT, ZERO = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


@pytest.mark.fault("static transforms that are invalid, or without end", "refused with a cause; at most 2048 are kept")
@pytest.mark.parametrize(
    ("payload", "cause"),
    [
        (b"", "message_malformed"),
        (packed(("a", "b", ZERO, UNIT))[:-3], "message_malformed"),
        (packed(claimed=1000), "message_malformed"),
        (packed(claimed=2**32 - 1), "transforms_too_many"),
        (b"\x00\x01\x00\x00" + bytes(MAX_MESSAGE_BYTES), "message_too_large"),
    ],
)
def test_what_is_no_transform_is_refused(payload: bytes, cause: str) -> None:
    with pytest.raises(DecodeError) as refused:
        decode_static_transforms(payload)
    assert refused.value.reason == cause


@pytest.mark.parametrize(
    ("invalid", "cause"),
    [
        (("a", "b", ZERO, (0.0, 0.0, 0.0, 0.0)), "transform_invalid"),
        (("a", "b", ZERO, (float("nan"), 0.0, 0.0, 1.0)), "transform_invalid"),
        (("a", "b", (float("inf"), 0.0, 0.0), UNIT), "transform_invalid"),
        (("a", "b", (1e12, 0.0, 0.0), UNIT), "transform_invalid"),
        (("a", "/a", ZERO, UNIT), "transform_invalid"),
        (("", "b", ZERO, UNIT), "frame_id_invalid"),
        (("a", "b" * 129, ZERO, UNIT), "frame_id_invalid"),
    ],
)
def test_an_invalid_transform_costs_no_other(invalid: tuple[Any, ...], cause: str) -> None:
    decoded = decode_static_transforms(packed(("base", "lidar", ZERO, UNIT), invalid, ("base", "camera", ZERO, UNIT)))
    assert [joint.child for joint in decoded.joints] == ["lidar", "camera"]
    ((names, error),) = decoded.refused.items()
    assert error.reason == cause
    assert all(len(name) <= 128 for name in names)


def test_the_refused_transforms_that_are_remembered_are_few() -> None:
    transforms = StaticTransforms()
    for number in range(1000):
        transforms.refuse({("a", str(number)): DecodeError("transform_invalid", "not rigid")})
    assert len(transforms.refused) == MAX_REFUSED


def test_values_that_contradict_each_other_are_named_where_they_lie_on_the_way() -> None:
    transforms = tree(("base", "lidar", np.eye(4)), ("base", "camera", T), ("base", "wheel", np.eye(4)))
    transforms.add((StaticTransform("base", "wheel", T), StaticTransform("base", "camera", T)))
    assert transforms.changes("camera", "lidar") == ()
    moved = se3.transform_from(se3.rotation_exp(np.array([0.0, 0.0, np.radians(2.0)])), np.array([0.0, 0.5, 0.0]))
    transforms.add((StaticTransform("base", "lidar", moved),))
    (sentence,) = transforms.changes("camera", "lidar")
    assert "'base' -> 'lidar' comes with several values, 2.00 deg and 0.500 m apart; the last one holds" in sentence


def test_a_flood_of_frames_ends_and_leaves_what_was_known() -> None:
    transforms = tree(("base", "lidar", T))
    many = tuple(StaticTransform("base", f"f{index}", T) for index in range(MAX_STATIC_TRANSFORMS))
    with pytest.raises(DecodeError, match="more than 2048"):
        transforms.add(many)
    assert transforms.frames == ("base", "lidar")
    transforms.add(many[1:])
    transforms.add(many[1:])
    assert len(transforms.frames) == MAX_STATIC_TRANSFORMS + 1
