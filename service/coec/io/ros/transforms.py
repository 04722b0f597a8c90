"""Transforms of ROS 2 (`tf2_msgs/TFMessage`), read with bounds: the tree of static transforms, and ego-motion from two
poses of a moving frame, also of an `Odometry` whose velocity is not what its poses show.

In tf each frame has one parent, and the latest transform of a joint holds. Names, positions and the number of joints
are bounded before anything is kept. Trees that violate tf's rule, and joints that change, are reported, so that the
code that reads a calibration from them can judge.

A transform tells where a frame is, not how fast it moves. For two poses T₁ and T₂ of the vehicle in `odom`, dt apart,
the twist between them is log(T₁⁻¹·T₂)/dt, in the vehicle's frame. It is exact if the twist is constant. Otherwise its
error is of second order in dt at the middle between the two poses, and that middle is its stamp.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.frames import message_evidence
from coec.calibration.types import EgoMotion, Matrix4
from coec.errors import DecodeError
from coec.geometry import se3
from coec.geometry.se3 import inverse, rotation_from_quaternion_xyzw, transform_from
from coec.io.frame_validation import MAX_FRAME_ID, Refusal
from coec.io.ros.message_decoding import check_motion, checked, odometry
from coec.io.ros.messages import MessageCursor, deserialized, frame_id, stamp_ns

MAX_TRANSFORMS: Final = 2048
"""Most transforms of a message; robots with many joints send some hundred at once."""

MAX_MESSAGE_BYTES: Final = 2**20
"""Largest message; `MAX_TRANSFORMS` transforms with names of usual length have 300 kB."""

MAX_PLACE_M: Final = 1e9
"""Largest translation per axis, metres; map frames may lie at the centre of the earth, 6.4e6 m away."""


def transforms_in(payload: bytes) -> list[Any]:
    """The `TransformStamped` in a `TFMessage` in CDR, unchanged.

    Raises:
        DecodeError: `message_too_large`, `transforms_too_many` or `message_malformed`.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        what = f"a message of transforms has at most {MAX_MESSAGE_BYTES} bytes"
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, what)
    if MessageCursor(payload).number() > MAX_TRANSFORMS:
        raise DecodeError(Refusal.TRANSFORMS_TOO_MANY, f"a message of transforms has at most {MAX_TRANSFORMS}")
    transforms: list[Any] = deserialized(ros.tf2_msgs__msg__TFMessage, payload).transforms
    return transforms


def pose_of(stamped: Any) -> Matrix4:
    """T_parent_child (4, 4), the pose of the child in its parent.

    Raises:
        DecodeError: `transform_invalid`.
    """
    rotation, place = stamped.transform.rotation, stamped.transform.translation
    place_m = np.array([place.x, place.y, place.z])
    if not (np.abs(place_m) <= MAX_PLACE_M).all():
        raise DecodeError(
            Refusal.TRANSFORM_INVALID, "not a rigid transform: its translation is not finite, or far away"
        )
    try:
        turn = rotation_from_quaternion_xyzw(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))
    except ValueError as error:
        raise DecodeError(Refusal.TRANSFORM_INVALID, f"not a rigid transform: {error}") from error
    return transform_from(turn, place_m)


def odometry_pose(payload: bytes) -> Matrix4 | None:
    """T_parent_child (4, 4) of an `Odometry`, the pose of the frame in which its twist is expressed; None if it is not
    filled in.

    Raises:
        DecodeError: not this message.
    """
    check_motion(payload)
    pose = deserialized(ros.nav_msgs__msg__Odometry, payload).pose.pose
    place_m = np.array([pose.position.x, pose.position.y, pose.position.z])
    turned = pose.orientation
    try:
        rotation = rotation_from_quaternion_xyzw(np.array([turned.x, turned.y, turned.z, turned.w]))
    except ValueError:
        return None
    return transform_from(rotation, place_m) if (np.abs(place_m) <= MAX_PLACE_M).all() else None


def bare(frame_id: str) -> str:
    """A frame id without the leading slash of ROS 1."""
    return frame_id.lstrip("/")


MAX_STATIC_TRANSFORMS: Final = 2048
"""Most joints that are kept; vehicles have some hundred."""

MAX_REFUSED: Final = 16
"""Most transforms that were left out and are remembered, so that a message can name them."""

SAME: Final = 1e-4
"""Values of one transform that differ by less (degrees, metres) are one value, written with other digits."""


@dataclass(frozen=True, slots=True)
class StaticTransform:
    """One static transform: `T_parent_child` (4, 4) is the pose of the child in its parent."""

    parent: str
    child: str
    T_parent_child: Matrix4


@dataclass(frozen=True, slots=True)
class DecodedTransforms:
    """The transforms of a message.

    Attributes:
        joints: the valid ones.
        refused: why each other one was left out, by its parent and child; tf2 leaves them out, too.
    """

    joints: tuple[StaticTransform, ...]
    refused: Mapping[tuple[str, str], DecodeError]


class StaticTransforms:
    """All static transforms received so far. Not safe for use from several threads.

    Attributes:
        replaced: how often a known joint came with another value.
        refused: why transforms were left out, by parent and child; at most `MAX_REFUSED`.
    """

    def __init__(self) -> None:
        self.replaced = 0
        self.refused: dict[tuple[str, str], DecodeError] = {}
        self._joints: dict[str, dict[str, StaticTransform]] = {}
        self._first: dict[tuple[str, str], StaticTransform] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """All named frames, sorted by name."""
        return tuple(sorted({*self._joints, *(parent for parents in self._joints.values() for parent in parents)}))

    def known(self, frame_id: str) -> str:
        """The frame of this name; else the only one with the same last part, because a namespace stands before one of
        the two (`robot/camera`, `camera`); else the name as it is, without a leading slash."""
        name, frames = bare(frame_id), self.frames
        same = [frame for frame in frames if f"/{frame}".endswith(f"/{name}") or f"/{name}".endswith(f"/{frame}")]
        return same[0] if name and name not in frames and len(same) == 1 else name

    def refuse(self, refused: Mapping[tuple[str, str], DecodeError]) -> None:
        """Notes transforms that were left out."""
        for names, error in refused.items():
            if len(self.refused) < MAX_REFUSED:
                self.refused[names] = error

    def add(self, joints: tuple[StaticTransform, ...]) -> None:
        """Add these joints; they replace earlier joints between the same frames.

        Raises:
            DecodeError: there would be more than `MAX_STATIC_TRANSFORMS`; then none is added.
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
                self._first.setdefault((joint.parent, joint.child), before)
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

    def changes(self, target: str, source: str) -> tuple[str, ...]:
        """The transforms on the way between two frames that came with several values, one sentence each: the last one
        holds."""
        way = [frame for frame, _ in self._path(bare(target), bare(source)) or ()]
        steps = {frozenset(step) for step in pairwise(way)}
        sentences = []
        for (parent, child), first in self._first.items():
            last = self._joints[child][parent]
            xi = se3.difference(first.T_parent_child, last.T_parent_child)
            turned_deg, moved_m = float(np.degrees(np.linalg.norm(xi[:3]))), float(np.linalg.norm(xi[3:]))
            if frozenset((parent, child)) in steps and max(turned_deg, moved_m) > SAME:
                distance = f"{turned_deg:.2f} deg and {moved_m:.3f} m apart"
                sentences.append(f"{parent!a} -> {child!a} comes with several values, {distance}; the last one holds")
        return tuple(sentences)

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


def decode_static_transforms(payload: bytes) -> DecodedTransforms:
    """The joints of a `TFMessage` in CDR, without those that are invalid.

    Raises:
        DecodeError: not this message.
    """
    joints: list[StaticTransform] = []
    refused: dict[tuple[str, str], DecodeError] = {}
    for stamped in transforms_in(payload):
        try:
            joints.append(_static_transform(stamped))
        except DecodeError as error:
            names = (bare(stamped.header.frame_id)[:MAX_FRAME_ID], bare(stamped.child_frame_id)[:MAX_FRAME_ID])
            refused[names] = error
    return DecodedTransforms(tuple(joints), refused)


def _static_transform(stamped: Any) -> StaticTransform:
    parent, child = bare(stamped.header.frame_id), bare(stamped.child_frame_id)
    if not 0 < len(parent) <= MAX_FRAME_ID or not 0 < len(child) <= MAX_FRAME_ID:
        what = f"a frame id of a transform is empty or longer than {MAX_FRAME_ID}"
        raise DecodeError(Refusal.FRAME_ID_INVALID, what)
    if parent == child:
        raise DecodeError(Refusal.TRANSFORM_INVALID, "a transform leads from a frame to itself")
    return StaticTransform(parent, child, pose_of(stamped))


MIN_BETWEEN_S: Final = 0.01
"""Least time between the two poses; then a millimetre, the resolution of a filter's poses, is 0.1 m/s."""

MAX_BETWEEN_S: Final = 0.5
"""Most time between the two poses; in a longer gap the velocity may have changed unnoticed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    stamp_ns: int
    T_parent_child: Matrix4


class MovingFrame:
    """Motion of one frame in another, from message to message. Not safe for use from several threads."""

    def __init__(self, parent: str, child: str) -> None:
        self._parent, self._child = bare(parent), bare(child)
        self._before: _Pose | None = None

    def motion(self, payload: bytes) -> EgoMotion | None:
        """The motion since the previous pose, from a `TFMessage` in CDR; None if the message holds no new pose of the
        frame, or if there was no previous pose.

        Raises:
            DecodeError: not this message, its pose is invalid, or the motion to it is impossible.
        """
        motion = None
        for stamped in transforms_in(payload):
            if bare(stamped.child_frame_id) != self._child:
                continue
            if bare(stamped.header.frame_id) == self._parent:
                motion = self._moved_to(_pose(stamped)) or motion
        return motion

    def _moved_to(self, pose: _Pose) -> EgoMotion | None:
        before = self._before
        if before is None:
            self._before = pose
            return None
        between_s = (pose.stamp_ns - before.stamp_ns) * 1e-9
        if 0.0 <= between_s < MIN_BETWEEN_S:
            return None
        self._before = pose
        if not 0.0 < between_s <= MAX_BETWEEN_S:
            return None
        twist = se3.log(se3.inverse(before.T_parent_child) @ pose.T_parent_child) / between_s
        wx, wy, wz, vx, vy, vz = (float(v) for v in twist)
        middle_ns = before.stamp_ns + (pose.stamp_ns - before.stamp_ns) // 2
        return checked(middle_ns, frame_id(self._child), (vx, vy, vz), (wx, wy, wz))


COMPARED_EVERY_S: Final = 0.5
"""Time from one comparison of the velocities of an odometry with its poses to the next, s."""

COMPARED: Final = 40
"""Latest comparisons that count: those of 20 s."""


class OdometryMotion:
    """The motion in `Odometry`, from message to message: its velocity; or the difference of its poses, once these have
    shown that the velocity is not meant as stated. Not safe for use from several threads.

    Attributes:
        note: what was recognised, and what to configure if that is wrong; empty: nothing.
    """

    def __init__(self, source: Literal["twist", "pose"] | None) -> None:
        """`source`: from what the motion is taken; None: it is recognised."""
        self.note = ""
        self._source = source
        self._is_open, self._opened_ns = False, -(2**62)
        self._compared: deque[message_evidence.PoseAndTwist] = deque(maxlen=2 * COMPARED)
        self._recent: deque[message_evidence.PoseAndTwist] = deque()

    def motion(self, payload: bytes) -> EgoMotion | None:
        """The motion, from an `Odometry` in CDR; None: there was no earlier pose, or no vehicle moves like that.

        Raises:
            DecodeError: not this message.
        """
        stated = odometry(payload)
        if self._source == "pose":
            return self._by_poses(message_evidence.PoseAndTwist(odometry_pose(payload), stated))
        if self._source is None and self._is_compared(stated.stamp_ns):
            self._compared.append(message_evidence.PoseAndTwist(odometry_pose(payload), stated))
            self._recognise()
        return stated

    def _is_compared(self, now_ns: int) -> bool:
        """Whether a message is the first or the second one of a comparison."""
        since_s = (now_ns - self._opened_ns) * 1e-9
        if self._is_open and message_evidence.LEAST_S <= since_s <= message_evidence.MOST_S:
            self._is_open = False
            return True
        if 0.0 <= since_s < COMPARED_EVERY_S:
            return False
        if since_s < 0.0:
            self._compared.clear()
        self._is_open, self._opened_ns = True, now_ns
        return True

    def _recognise(self) -> None:
        reading = message_evidence.reading_of_twists(tuple(self._compared))
        if reading is message_evidence.TwistReading.CONTRADICTED:
            self.note = (
                "The velocities of the odometry do not fit its poses; the velocities are used. If the poses are right, "
                "say ego.motion: pose."
            )
        elif reading is not message_evidence.TwistReading.AS_STATED:
            # It stays so: a vehicle that stands shows nothing.
            self._source = "pose"
            self.note = (
                f"The velocities of the odometry are {reading}, by its poses: the motion is taken from the differences "
                "of the poses. If the velocities are right, say ego.motion: twist."
            )

    def _by_poses(self, message: message_evidence.PoseAndTwist) -> EgoMotion | None:
        """The motion since the latest pose that is `message_evidence.LEAST_S` earlier."""
        if message.T_parent_child is None:
            return None
        recent = self._recent
        if recent and recent[-1].stamp_ns >= message.stamp_ns:
            recent.clear()
        recent.append(message)
        while len(recent) > 2 and message.stamp_ns - recent[1].stamp_ns >= message_evidence.LEAST_S * 1e9:
            recent.popleft()
        for motion in message_evidence.motions_of_poses((recent[0], message)):
            assert motion.linear_mps is not None
            return checked(motion.stamp_ns, motion.frame_id, motion.linear_mps, motion.angular_radps)
        return None


def frames_in(payload: bytes) -> set[tuple[str, str]]:
    """Parent and child of every transform in a `TFMessage` in CDR.

    Raises:
        DecodeError: not this message.
    """
    return {(frame_id(bare(t.header.frame_id)), frame_id(bare(t.child_frame_id))) for t in transforms_in(payload)}


def _pose(stamped: Any) -> _Pose:
    return _Pose(stamp_ns(stamped.header), pose_of(stamped))
