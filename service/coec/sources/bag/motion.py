"""Finds the topic of a bag that gives the motion of the vehicle, and takes motion from the transforms of `/tf`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from coec.adapters.ros.moving_frames import MovingFrame, frames_in
from coec.calibration.types import EgoMotion
from coec.errors import DecodeError, SourceError
from coec.sources.bag.index import ROTATION_TYPES, VELOCITY_TYPES, BagIndex
from coec.sources.bag.storage import BagReader

VEHICLE: Final = ("odom", "base_link")
"""The frame in which a vehicle moves and the vehicle's own frame, as REP 105 names them."""

_LISTED: Final = 12
"""How many joints an error lists."""


def motion_topic(index: BagIndex, reader: BagReader, frames: tuple[str, str], requested: str | None) -> str | None:
    """The topic that was asked for; else the only one of velocities, else one of transforms of the vehicle (`frames`:
    parent, child), else the only one of turn rates; None if there is none.

    Raises:
        SourceError: there is no topic as asked for, or there are several of the best kind.
    """
    if requested in index.transforms_at:
        return requested
    if requested is not None:
        return index.optional_topic((*VELOCITY_TYPES, *ROTATION_TYPES), requested, "odometry")
    selected = index.optional_topic(VELOCITY_TYPES, None, "odometry")
    if selected is None:
        # Most bags have /tf, and in most of them the moving transforms are joints of a robot.
        selected = next(
            (topic for topic in sorted(index.transforms_at) if _motions(index, reader, topic, frames)), None
        )
    return selected or index.optional_topic(ROTATION_TYPES, None, "odometry")


def motions_of_transforms(
    index: BagIndex, reader: BagReader, topic: str, frames: tuple[str, str]
) -> tuple[EgoMotion, ...]:
    """The motion of the vehicle in the transforms of a topic, in the order of their stamps.

    Raises:
        SourceError: the transforms do not have the vehicle's frames; lists those that they have.
    """
    motions = _motions(index, reader, topic, frames)
    if not motions:
        there = sorted(_joints(index, reader, topic))
        joints_text = ", ".join(f"{parent},{child}" for parent, child in there[:_LISTED])
        more = ", ..." if len(there) > _LISTED else ""
        raise SourceError(
            f"{index.path}: {topic} does not say how {frames[1]!a} moves in {frames[0]!a}; name the frames with "
            f"?moving=PARENT,CHILD; there: {joints_text or 'none'}{more}"
        )
    return tuple(sorted(motions, key=lambda motion: motion.stamp_ns))


def _motions(index: BagIndex, reader: BagReader, topic: str, frames: tuple[str, str]) -> list[EgoMotion]:
    moving = MovingFrame(*frames)
    try:
        motions = [moving.motion(data) for data in _messages(index, reader, topic)]
    except DecodeError as error:
        raise SourceError(f"{index.path}: a message on {topic} is refused: {error}") from error
    return [motion for motion in motions if motion is not None]


def _joints(index: BagIndex, reader: BagReader, topic: str) -> set[tuple[str, str]]:
    return {joint for data in _messages(index, reader, topic) for joint in frames_in(data)}


def _messages(index: BagIndex, reader: BagReader, topic: str) -> Iterable[bytes]:
    return (reader.read(place) for place in index.transforms_at[topic])
