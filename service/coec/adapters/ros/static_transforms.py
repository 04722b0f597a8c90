"""The tree of static transforms (`/tf_static`): the poses between the frames of a vehicle.

In tf each frame has one parent, and the latest transform of a joint holds. Names, positions and the number of joints
are bounded before anything is kept. Trees that violate tf's rule, and joints that change, are reported, so that the
code that reads a calibration from them can judge.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from coec.adapters.frames.incoming import MAX_FRAME_ID, Refusal
from coec.adapters.ros.transforms import bare, pose_of, transforms_in
from coec.calibration.types import Matrix4
from coec.errors import DecodeError
from coec.geometry.se3 import inverse

MAX_STATIC_TRANSFORMS: Final = 2048
"""Most joints that are kept; vehicles have some hundred."""


@dataclass(frozen=True, slots=True)
class StaticTransform:
    """One static transform: `T_parent_child` (4, 4) is the pose of the child in its parent."""

    parent: str
    child: str
    T_parent_child: Matrix4


class StaticTransforms:
    """All static transforms received so far. Not safe for use from several threads.

    Attributes:
        replaced: how often a known joint came with another value.
    """

    def __init__(self) -> None:
        self.replaced = 0
        self._joints: dict[str, dict[str, StaticTransform]] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """All named frames, sorted by name."""
        return tuple(sorted({*self._joints, *(parent for parents in self._joints.values() for parent in parents)}))

    def add(self, joints: tuple[StaticTransform, ...]) -> None:
        """Add these joints; they replace earlier joints between the same frames.

        Raises:
            DecodeError: there would be more than `MAX_JOINTS`; then none is added.
        """
        known = {(joint.child, joint.parent) for parents in self._joints.values() for joint in parents.values()}
        fresh = {(joint.child, joint.parent) for joint in joints} - known
        if len(known) + len(fresh) > MAX_STATIC_TRANSFORMS:
            raise DecodeError(Refusal.TRANSFORMS_TOO_MANY, f"more than {MAX_STATIC_TRANSFORMS} static transforms")
        for joint in joints:
            parents = self._joints.setdefault(joint.child, {})
            before = parents.get(joint.parent)
            if before is not None and not np.array_equal(before.T_parent_child, joint.T_parent_child):
                self.replaced += 1
            parents[joint.parent] = joint

    def transform(self, target: str, source: str) -> Matrix4 | None:
        """T_target_source (4, 4) along the fewest joints; None if no joints connect the two frames."""
        way = self._path(bare(target), bare(source))
        return None if way is None else way[-1][1]

    def doubts(self, target: str, source: str) -> tuple[str, ...]:
        """What violates the tree on the way between two frames, one sentence each: a frame with several parents, of
        which tf takes the one it heard last, or a loop."""
        on_the_way = {frame for frame, _ in self._path(bare(target), bare(source)) or ()}
        several = [
            f"frame {child!r} has the parents {' and '.join(repr(parent) for parent in sorted(parents))}"
            for child, parents in sorted(self._joints.items())
            if len(parents) > 1 and child in on_the_way
        ]
        loops = [
            f"the frames {', '.join(repr(frame) for frame in loop)} form a loop"
            for loop in self._loops()
            if on_the_way.intersection(loop)
        ]
        return (*several, *loops)

    def _path(self, target: str, source: str) -> list[tuple[str, Matrix4]] | None:
        """The frames from source to target, each with T_frame_source (4, 4)."""
        predecessor: dict[str, str] = {source: source}
        reached = {source: np.eye(4)}
        frontier = deque([source])
        neighbours = self._neighbours()
        while frontier and target not in reached:
            frame = frontier.popleft()
            for neighbour, T_neighbour_frame in neighbours.get(frame, {}).items():
                if neighbour not in reached:
                    predecessor[neighbour] = frame
                    reached[neighbour] = T_neighbour_frame @ reached[frame]
                    frontier.append(neighbour)
        if target not in reached:
            return None
        way = [target]
        while way[-1] != source:
            way.append(predecessor[way[-1]])
        return [(frame, reached[frame]) for frame in reversed(way)]

    def _neighbours(self) -> dict[str, dict[str, Matrix4]]:
        """T_neighbour_frame by frame and neighbour."""
        neighbours: dict[str, dict[str, Matrix4]] = {}
        for parents in self._joints.values():
            for joint in parents.values():
                neighbours.setdefault(joint.child, {})[joint.parent] = joint.T_parent_child
                neighbours.setdefault(joint.parent, {})[joint.child] = inverse(joint.T_parent_child)
        return neighbours

    def _loops(self) -> Iterator[list[str]]:
        """Paths from child to parent that lead back to a frame on them, each once. Of several parents only the first is
        followed, because several parents are reported anyway."""
        done: set[str] = set()
        for start in sorted(self._joints):
            way: dict[str, None] = {}
            frame: str | None = start
            while frame is not None and frame not in done and frame not in way:
                way[frame] = None
                frame = next(iter(self._joints.get(frame, {})), None)
            if frame in way:
                frames = list(way)
                yield frames[frames.index(frame) :]
            done.update(way)


def decode_static_transforms(payload: bytes) -> tuple[StaticTransform, ...]:
    """The joints of a `TFMessage` in CDR.

    Raises:
        DecodeError: not this message, or one of its transforms is invalid.
    """
    return tuple(_static_transform(stamped) for stamped in transforms_in(payload))


def _static_transform(stamped: Any) -> StaticTransform:
    parent, child = bare(stamped.header.frame_id), bare(stamped.child_frame_id)
    if not 0 < len(parent) <= MAX_FRAME_ID or not 0 < len(child) <= MAX_FRAME_ID:
        what = f"a frame id of a transform is empty or longer than {MAX_FRAME_ID}"
        raise DecodeError(Refusal.FRAME_ID_INVALID, what)
    if parent == child:
        raise DecodeError(Refusal.TRANSFORM_INVALID, "a transform leads from a frame to itself")
    return StaticTransform(parent, child, pose_of(stamped))
