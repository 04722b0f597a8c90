"""Discovery: completes a pair whose configuration leaves out its calibration from what was received on the bus, or
says what is still missing; and stores discovered calibrations in the state directory, so that a restart has the
same ones, whatever is published by then. What the configuration gives is used as it is; only what it leaves out is
looked for. Nothing is assumed: the pair stays pending if `/tf_static` does not connect two frames, or an image has
another size than its `CameraInfo`.
"""

import json
import logging
import re
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from coec.calibration.frames.message_evidence import sees_alone
from coec.calibration.types import ImageFormat, Matrix4, Reason
from coec.config import (
    IDENTITY,
    AnyStreamConfig,
    CameraIntrinsics,
    Config,
    LimitsConfig,
    Matrix4x4,
    OpenPairConfig,
    PairConfig,
    config_hash,
    describe,
)
from coec.errors import ConfigError, SourceError
from coec.geometry.se3 import difference
from coec.io.frame_validation import BYTES_PER_PIXEL
from coec.io.rig_files import matrix_rows, rig_of
from coec.io.ros.camera_info import CameraInfoContent, info_topic, intrinsics_of_info, is_rectified
from coec.io.ros.messages import IMAGE
from coec.io.ros.transforms import StaticTransforms, bare
from coec.io.storage import StateFile
from coec.schemas.keys import TF_STATIC
from coec.schemas.message import Part

T = TypeVar("T")


CHANGED_RAD, CHANGED_M = 1e-6, 1e-6
"""A transform that differs by more than this is another one (rad, m). One that is published again differs only by the
rounding of float64. These limits are a thousandth of what a calibration finds."""

CANNOT_BE_BUILT = "cannot_be_built"
"""Code of a reason: no rig can be built of what was found."""

SHOWN_FRAMES = 24
"""How many frames a sentence lists at most."""

_PLAIN = re.compile(r"[A-Za-z0-9_./:-]{1,64}")
"""Names of frames as people give them. Other names are not repeated, because a sender chose them."""

INTRINSICS, EXTRINSIC, CAMERA_FRAME, LIDAR_FRAME, CLOUD, EGO = (
    "camera.intrinsics",
    "T_camera_lidar",
    "camera.frame_id",
    "lidar.frame_id",
    "lidar.T_cloud_lidar",
    "ego.T_lidar_ego",
)
"""Places of a pair's configuration that can be found on the bus."""


LATEST = 32
"""Frames of a stream whose names are compared: at four a second those of eight seconds, so that a driver that was
started with another name is soon forgotten."""


@dataclass(frozen=True, slots=True)
class ReceivedImage:
    """The latest image: the frame in its header and its size, px."""

    frame_id: str
    width: int
    height: int


@dataclass(slots=True)
class ReceivedMetadata:
    """What was heard of one pair so far. `cloud` and `ego` are the frame names in the latest cloud and motion.
    `packets` names the LiDAR whose packets came, with what is to be said of it.
    `names` has the frames that the latest messages of a stream (`camera`, `lidar`) name.
    `refused` says for a source (`camera`, `lidar`, `ego`, `info`) why its latest message could not be used.
    `max_message_bytes` is the largest message that the session lets through. `points_m` are some points (N, 3) of the
    latest cloud."""

    image: ReceivedImage | None = None
    cloud: str | None = None
    ego: str | None = None
    packets: str = ""
    info: CameraInfoContent | None = None
    names: dict[str, deque[str]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    max_message_bytes: int = LimitsConfig().max_message_bytes
    points_m: NDArray[np.float32] | None = None

    def add_name(self, stream: str, frame_id: str) -> None:
        """Notes the frame that a message of a stream names."""
        self.names.setdefault(stream, deque(maxlen=LATEST)).append(frame_id)

    def dropped_bytes(self, pair: OpenPairConfig) -> int:
        """Bytes of a raw colour image of the size in the `CameraInfo`, if that is above the limit, so that Zenoh drops
        each image unseen; 0 if images come, or need not be so large."""
        if self.image is not None or self.info is None or pair.camera.assumed_type != IMAGE:
            return 0
        size = self.info.size[0] * self.info.size[1] * BYTES_PER_PIXEL[ImageFormat.BGR8]
        return size if size > self.max_message_bytes else 0


@dataclass(frozen=True, slots=True)
class DiscoveredPair:
    """A complete pair, and where each found value comes from, by its place in the configuration."""

    pair: PairConfig
    origins: Mapping[str, str]


def info_topic_of(pair: OpenPairConfig) -> str | None:
    """The topic of the `CameraInfo` with the intrinsics. None if the intrinsics are given, or if the images come on a
    key, which has no namespace."""
    camera = pair.camera
    if camera.intrinsics is not None:
        return None
    if camera.info_topic is not None:
        return camera.info_topic
    return None if camera.topic is None else info_topic(camera.topic)


def needs_transforms(pair: OpenPairConfig) -> bool:
    """Whether anything that the configuration leaves out comes from `/tf_static`."""
    ego = pair.ego
    return (
        pair.T_camera_lidar is None
        or (pair.lidar.frame_id is not None and pair.lidar.T_cloud_lidar is None)
        or (ego is not None and ego.T_lidar_ego is None)
    )


def discover(
    pair: OpenPairConfig, received: ReceivedMetadata, transforms: StaticTransforms
) -> DiscoveredPair | tuple[Reason, ...]:
    """The complete pair; or a reason for each thing that it waits for."""
    search = _Search(pair, received, transforms)
    intrinsics = search.resolve(search.intrinsics)
    camera_frame, cloud_frame = search.resolve(search.camera_frame), search.resolve(search.cloud_frame)
    lidar_frame = pair.lidar.frame_id or cloud_frame
    T_cloud_lidar = search.resolve(search.T_cloud_lidar, cloud_frame, lidar_frame)
    T_camera_lidar = search.resolve(lambda: search.T_camera_lidar(camera_frame, lidar_frame, intrinsics))
    T_lidar_ego = search.resolve(search.T_lidar_ego, lidar_frame)
    if search.missing:
        return tuple(search.missing)
    document = pair.model_dump()
    document["T_camera_lidar"] = T_camera_lidar
    document["camera"] |= {"frame_id": camera_frame, "intrinsics": intrinsics}
    document["lidar"] |= {"frame_id": lidar_frame, "T_cloud_lidar": T_cloud_lidar}
    if cloud_frame != lidar_frame:
        document["lidar"]["cloud_frame_id"] = cloud_frame
    if pair.ego is not None:
        document["ego"]["T_lidar_ego"] = T_lidar_ego
    try:
        return DiscoveredPair(PairConfig.model_validate(document), search.origins)
    except ValidationError as error:
        return (Reason(CANNOT_BE_BUILT, f"The discovered calibration cannot be used: {describe(error)}."),)


class _MissingError(Exception):
    """A value is missing, for a reason."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.text)
        self.reason = reason


class _Search:
    """One search for everything that is left out. Each method returns what the configuration gives, else what was
    found. It returns None if it depends on another value that is missing, and raises if its own value is."""

    def __init__(self, pair: OpenPairConfig, received: ReceivedMetadata, transforms: StaticTransforms) -> None:
        self._pair = pair
        self._received = received
        self._transforms = transforms
        self.origins: dict[str, str] = {}
        self.missing: list[Reason] = []

    def resolve(self, question: Callable[..., T | None], *known: str | None) -> T | None:
        """The value of a question; None, and a reason in `missing`, if it is missing."""
        try:
            return question(*known)
        except _MissingError as error:
            self.missing.append(error.reason)
            return None

    def intrinsics(self) -> CameraIntrinsics | None:
        pair, received = self._pair, self._received
        if pair.camera.intrinsics is not None:
            return pair.camera.intrinsics
        topic = info_topic_of(pair)
        if topic is None:
            raise _MissingError(Reason("no_camera_info", "Images on a key have no CameraInfo: set camera.info_topic."))
        if "info" in received.refused:
            text = f"The CameraInfo on {topic} is refused: {received.refused['info']}."
            raise _MissingError(Reason("camera_info_refused", text))
        if received.info is None:
            raise _MissingError(Reason("no_camera_info", f"No CameraInfo on {topic} yet."))
        try:
            lens = intrinsics_of_info(received.info, rectified=is_rectified(pair.camera.place))
        except SourceError as error:
            raise _MissingError(
                Reason("camera_info_refused", f"The CameraInfo on {topic} cannot be used: {error}.")
            ) from error
        size, image = lens.intrinsics, received.image
        if image is not None and (image.width, image.height) != (size.width, size.height):
            sizes = f"{image.width} x {image.height} px, the CameraInfo on {topic} is for {size.width} x {size.height}"
            raise _MissingError(Reason("camera_info_size", f"Images on {pair.camera.place} are {sizes} px."))
        self.origins[INTRINSICS] = f"CameraInfo on {topic}: {lens.source}"
        of_lens = received.info.frame_id
        if image is not None and self._transforms.known(of_lens) != self._transforms.known(image.frame_id):
            self.origins[INTRINSICS] += f"; of the frame {_named(of_lens)}, the images name {_named(image.frame_id)}"
        return lens.intrinsics

    def camera_frame(self) -> str | None:
        pair, image = self._pair, self._received.image
        if image is None and (pair.camera.frame_id is None or pair.camera.intrinsics is None):
            text = self._silent("camera", "image", pair.camera.place)
            dropped = self._received.dropped_bytes(pair)
            if dropped:
                limit = self._received.max_message_bytes
                text += (
                    f" Images of the size in its CameraInfo have {dropped} bytes as raw colours, and messages above "
                    f"limits.max_message_bytes, {limit}, are dropped before they are seen: raise that, here and at the "
                    "router, or take the topic of compressed images."
                )
            raise _MissingError(Reason("no_image", text))
        if pair.camera.frame_id is not None:
            return pair.camera.frame_id
        assert image is not None
        if not image.frame_id:
            raise _MissingError(Reason("no_frame_id", _frameless("Images", pair.camera, "camera.frame_id")))
        self._require_one_frame("camera", "images", pair.camera, CAMERA_FRAME)
        self.origins[CAMERA_FRAME] = f"the latest image on {pair.camera.place} before the pair was built"
        return image.frame_id

    def cloud_frame(self) -> str | None:
        lidar, cloud = self._pair.lidar, self._received.cloud
        if lidar.cloud_frame_id is not None:
            return lidar.cloud_frame_id
        if cloud is None:
            raise _MissingError(Reason("no_cloud", self._silent("lidar", "cloud", lidar.place)))
        if not cloud:
            raise _MissingError(Reason("no_frame_id", _frameless("Clouds", lidar, "lidar.cloud_frame_id")))
        self._require_one_frame("lidar", "clouds", lidar, "lidar.cloud_frame_id")
        if lidar.frame_id is None:
            self.origins[LIDAR_FRAME] = f"the latest cloud on {lidar.place} before the pair was built"
            if self._received.packets:
                self.origins[LIDAR_FRAME] = f"packets on {lidar.place}: {self._received.packets}"
        return cloud

    def T_cloud_lidar(self, cloud: str | None, lidar: str | None) -> Matrix4x4 | None:
        given = self._pair.lidar.T_cloud_lidar
        if given is not None or cloud is None or lidar is None:
            return given
        return IDENTITY if bare(cloud) == bare(lidar) else self._rows(CLOUD, cloud, lidar)

    def T_camera_lidar(
        self, camera: str | None, lidar: str | None, intrinsics: CameraIntrinsics | None
    ) -> Matrix4x4 | None:
        given, info = self._pair.T_camera_lidar, self._received.info
        if given is not None or camera is None or lidar is None:
            return given
        optical = "" if info is None else info.frame_id
        if not optical or not self._is_body(camera, optical, lidar, intrinsics):
            return self._rows(EXTRINSIC, camera, lidar)
        # A driver may name another frame in its images than in the CameraInfo, which is that of the lens.
        rows = self._rows(EXTRINSIC, optical, lidar)
        self.origins[EXTRINSIC] += f"; the frame is that of the CameraInfo, the images name {_named(camera)}"
        return rows

    def _is_body(self, camera: str, optical: str, lidar: str, lens: CameraIntrinsics | None) -> bool:
        """Whether the frame of the images is not that of the camera, but that of the `CameraInfo` is: transforms lead
        only from there to the LiDAR, or points of the latest cloud lie only there before the camera."""
        frames = [self._transforms.known(frame) for frame in (optical, camera)]
        T_optical, T_camera = (self._transforms.transform(frame, self._transforms.known(lidar)) for frame in frames)
        if T_optical is None or T_camera is None:
            return T_optical is not None
        cloud = self._transforms.known(self._received.cloud or lidar)
        poses = [self._transforms.transform(frame, cloud) for frame in frames]
        points_m = self._received.points_m
        if lens is None or points_m is None or any(pose is None for pose in poses):
            return False
        return sees_alone(*(_share_in_view(lens, pose, points_m) for pose in poses if pose is not None))

    def T_lidar_ego(self, lidar: str | None) -> Matrix4x4 | None:
        ego, frame = self._pair.ego, self._received.ego
        if ego is None or ego.T_lidar_ego is not None or lidar is None:
            return None if ego is None else ego.T_lidar_ego
        if frame is None:
            raise _MissingError(Reason("no_motion", self._silent("ego", "motion", ego.place)))
        if not frame:
            raise _MissingError(Reason("no_frame_id", _frameless("Motions", ego, "ego.T_lidar_ego")))
        return IDENTITY if bare(frame) == bare(lidar) else self._rows(EGO, lidar, frame)

    def _rows(self, place: str, target: str, source: str) -> Matrix4x4 | None:
        known = [self._transforms.known(frame) for frame in (target, source)]
        taken = [
            f"{_named(frame)} is taken for {_named(other)}"
            for frame, other in zip((target, source), known, strict=True)
            if frame != other
        ]
        target, source = known
        T_target_source = self._transforms.transform(target, source)
        names = f"{_named(target)} and {_named(source)}"
        if T_target_source is None:
            there = _listed(self._transforms.frames)
            text = (
                f"{TF_STATIC} does not connect {names} (for {place}): {there}.{_left_out(self._transforms)} Publish "
                f"the missing transform on it (one on /tf may move, and is not taken), or set {place}."
            )
            raise _MissingError(Reason("tf_static", text))
        doubts = self._transforms.doubts(target, source)
        if doubts:
            raise _MissingError(
                Reason("tf_static_no_tree", f"{TF_STATIC} is no tree between {names}: {'; '.join(doubts)}.")
            )
        changes = self._transforms.changes(target, source)
        self.origins[place] = "; ".join((f"{TF_STATIC}, between {names}", *taken, *changes))
        return matrix_rows(T_target_source)

    def _require_one_frame(self, stream: str, what: str, config: AnyStreamConfig, place: str) -> None:
        counts = Counter(bare(name) for name in self._received.names.get(stream, ()))
        if len(counts) > 1:
            named = ", ".join(f"{_named(frame)} ({count})" for frame, count in counts.most_common(SHOWN_FRAMES))
            text = (
                f"The latest {what} on {config.place} name {len(counts)} frames: {named}. Two sensors publish on it: "
                f"give each a topic of its own, or choose one with {place}."
            )
            raise _MissingError(Reason("several_sensors", text))

    def _silent(self, stream: str, what: str, place: str) -> str:
        refused = self._received.refused.get(stream)
        return f"No {what} on {place} yet." if refused is None else f"No {what} on {place} can be used: {refused}."


def change_since(
    discovered: DiscoveredPair, pair: OpenPairConfig, received: ReceivedMetadata, transforms: StaticTransforms
) -> Reason | None:
    """In what the bus now contradicts the values with which the pair was built; None if in nothing."""
    built = discovered.pair
    changes = []
    if INTRINSICS in discovered.origins and received.info is not None:
        try:
            now: object = intrinsics_of_info(received.info, rectified=is_rectified(pair.camera.place)).intrinsics
        except SourceError as error:
            now = str(error)
        if now != built.camera.intrinsics:
            changes.append(f"CameraInfo on {info_topic_of(pair)}")
    ego = None if built.ego is None else built.ego.T_lidar_ego
    for place, rows, target, source in (
        (EXTRINSIC, built.T_camera_lidar, built.camera.frame_id, built.lidar.frame_id),
        (CLOUD, built.lidar.T_cloud_lidar, built.lidar.cloud_frame_id, built.lidar.frame_id),
        (EGO, ego, built.lidar.frame_id, received.ego),
    ):
        if place in discovered.origins and rows is not None and target is not None and source is not None:
            targets = [target]
            if place == EXTRINSIC and received.info is not None:
                targets.append(received.info.frame_id)  # which may be the frame of the camera
            now_there = [transforms.transform(transforms.known(one), transforms.known(source)) for one in targets]
            known = [T_now for T_now in now_there if T_now is not None]
            if known and all(_differ(np.array(rows), T_now) for T_now in known):
                changes.append(f"{TF_STATIC}, for {place}")
    if not changes:
        return None
    text = (
        f"The bus has changed since this pair was built: {' and '.join(changes)}. What it was built with remains the "
        "nominal calibration: to take the new one, stop the service, remove nominal.json from its state "
        "directory, and start it."
    )
    return Reason("nominal_changed", text)


def _share_in_view(lens: CameraIntrinsics, T_camera_cloud: Matrix4, points_m: NDArray[np.float32]) -> float:
    """Share of the points (N, 3) within the angle to the axis at which the farthest corner lies at most, whatever the
    lens."""
    p_camera = points_m.astype(np.float64) @ T_camera_cloud[:3, :3].T + T_camera_cloud[:3, 3]
    corner = np.hypot(max(lens.cx, lens.width - lens.cx) / lens.fx, max(lens.cy, lens.height - lens.cy) / lens.fy)
    angle_rad = np.arctan2(np.hypot(p_camera[:, 0], p_camera[:, 1]), p_camera[:, 2])
    return float((angle_rad <= corner).mean()) if len(angle_rad) else 0.0


def _differ(T_a: Matrix4, T_b: Matrix4) -> bool:
    xi = np.abs(difference(T_a, T_b))
    return bool(xi[:3].max() > CHANGED_RAD or xi[3:].max() > CHANGED_M)


def _frameless(what: str, stream: AnyStreamConfig, place: str) -> str:
    return f"{what} on {stream.place} name no frame: set {place}."


def _named(frame: str) -> str:
    """The name of a frame for people to read; a name that is not plain is not repeated."""
    return repr(frame) if _PLAIN.fullmatch(frame) else "(a frame whose name is not plain)"


def _listed(frames: Iterable[str]) -> str:
    known = [frame for frame in frames if _PLAIN.fullmatch(frame)]
    if not known:
        return "it names no frames yet"
    more = f" and {len(known) - SHOWN_FRAMES} more" if len(known) > SHOWN_FRAMES else ""
    return f"there are {', '.join(known[:SHOWN_FRAMES])}{more}"


def _left_out(transforms: StaticTransforms) -> str:
    if not transforms.refused:
        return ""
    listed = ", ".join(f"{_named(parent)} -> {_named(child)}" for parent, child in transforms.refused)
    return f" Invalid transforms were left out: {listed}."


_log = logging.getLogger(__name__)

NOMINAL_FILE = "nominal.json"


class StoredCamera(Part):
    """What is found of a camera."""

    frame_id: str
    intrinsics: CameraIntrinsics


class StoredLidar(Part):
    """What is found of a LiDAR."""

    frame_id: str
    T_cloud_lidar: Matrix4x4
    cloud_frame_id: str | None


class StoredEgo(Part):
    """What is found of the ego-motion."""

    T_lidar_ego: Matrix4x4


class StoredNominal(Part):
    """What is found of a pair, out of its configuration. The file holds the whole `PairConfig`, which versions before
    this one require; its other keys may be those of another version."""

    T_camera_lidar: Matrix4x4
    camera: StoredCamera
    lidar: StoredLidar
    ego: StoredEgo | None = None


class StoredDiscovery(Part):
    """`DiscoveredPair` on the disk. `asked` is the hash of what the configuration left out and where it was looked for.
    `found_ns` is the wall clock when it was found."""

    asked: str
    found_ns: Annotated[int, Field(ge=0, lt=2**63)]
    pair: StoredNominal
    origins: dict[str, str]


class DiscoveryStore:
    """The nominal calibrations of a vehicle, which the disk writer stores. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self._file = StateFile(folder / NOMINAL_FILE)
        loaded = self._file.load()
        for damage in loaded.damage:
            _log.warning(f"stored nominal calibrations cannot be used: {damage}")
        self._pairs: dict[str, StoredDiscovery] = {}
        self._documents: dict[str, dict[str, Any]] = {}
        pairs = (loaded.body or {}).get("pairs")
        for name, document in (pairs if isinstance(pairs, dict) else {}).items():
            try:
                self._pairs[name] = StoredDiscovery.model_validate(document)
                self._documents[name] = document
            except ValidationError:
                self._file.reject()
                _log.warning("a stored nominal calibration has another form", extra={"fields": {"pair": name}})

    def load(self, config: Config) -> dict[str, DiscoveredPair]:
        """What was found earlier, by pair, for the pairs that this configuration awaits and for which it still asks the
        same."""
        pairs = {pair.name: self._restored(pair, config) for pair in config.awaited}
        return {name: one for name, one in pairs.items() if one is not None}

    def _restored(self, pair: OpenPairConfig, config: Config) -> DiscoveredPair | None:
        with self._lock:
            stored = self._pairs.get(pair.name)
        if stored is None or stored.asked != _request_hash(pair, config):
            return None
        document, earlier = pair.model_dump(), stored.pair
        document["T_camera_lidar"] = earlier.T_camera_lidar
        document["camera"] |= earlier.camera.model_dump()
        document["lidar"] |= earlier.lidar.model_dump()
        if pair.ego is not None and earlier.ego is not None:
            document["ego"]["T_lidar_ego"] = earlier.ego.T_lidar_ego
        try:
            complete = PairConfig.model_validate(document)
            rig_of(complete)  # may fail, because the mask may have changed on the disk
        except (ConfigError, ValidationError) as error:
            _log.warning(f"a stored nominal calibration cannot be used: {error}")
            return None
        since = datetime.fromtimestamp(stored.found_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        return DiscoveredPair(
            complete, {place: f"{origin}; kept since {since}" for place, origin in stored.origins.items()}
        )

    def update(self, discovered: DiscoveredPair, requested: OpenPairConfig, config: Config, now_ns: int) -> None:
        """Keeps what was found; the next `flush` writes it."""
        document = {
            "asked": _request_hash(requested, config),
            "found_ns": now_ns,
            "pair": discovered.pair.model_dump(mode="json"),
            "origins": dict(discovered.origins),
        }
        stored = StoredDiscovery.model_validate(document)
        with self._lock:
            self._pairs = {**self._pairs, requested.name: stored}
            self._documents = {**self._documents, requested.name: document}

    def flush(self) -> None:
        """Writes to the disk what is kept.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        with self._lock:
            documents = self._documents
        self._file.save({"pairs": documents})


def _request_hash(pair: OpenPairConfig, config: Config) -> str:
    """Hash of what the configuration gives and where the rest is looked for. Other settings may change."""
    question = pair.model_dump(
        mode="json",
        include={
            "camera": {"key", "topic", "info_topic", "frame_id", "intrinsics"},
            "lidar": {"key", "topic", "frame_id", "T_cloud_lidar", "cloud_frame_id"},
            "ego": {"key", "topic", "T_lidar_ego"},
            "T_camera_lidar": True,
        },
    )
    where = {"middleware": config.middleware, **config.ros.model_dump(include={"domain", "namespace"})}
    return config_hash(json.dumps([question, where], sort_keys=True))


def completed(config: Config, discovered: Mapping[str, PairConfig]) -> Config:
    """The configuration in which these pairs, by their names, are moved from the awaited ones to the complete ones."""
    joined = tuple(discovered[pair.name] for pair in config.awaited if pair.name in discovered)
    still = tuple(pair for pair in config.awaited if pair.name not in discovered)
    return config.model_copy(update={"pairs": (*config.pairs, *joined), "awaited": still})


def with_discovered(config: Config) -> Config:
    """The configuration completed by what a service has found for its awaited pairs and keeps in its state
    directory."""
    if not config.awaited:
        return config
    stored = DiscoveryStore(config.state.directory).load(config)
    return completed(config, {name: discovered.pair for name, discovered in stored.items()})
