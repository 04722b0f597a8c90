"""The rig of a pair in a bag: intrinsics from a `CameraInfo` or a file, and the extrinsic along the transforms of the
bag, between the frames that its messages name. Where the two do not agree by name, the frame is recognised; what was
recognised, left out or overridden is told.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Matrix4, Recognition, Rig
from coec.config import CameraIntrinsics, FilePath, Matrix4x4, describe
from coec.config.pose_forms import with_direction
from coec.errors import ConfigError, SourceError
from coec.geometry.projection import share_in_image
from coec.io.intrinsics_files import load_camera_document, with_camera
from coec.io.recordings.bag_folder import METADATA
from coec.io.recordings.bag_index import LISTED, BagIndex
from coec.io.rig_files import camera_of, load_mask, rigid_matrix
from coec.io.ros import camera_info
from coec.io.ros.transforms import bare
from coec.io.user_files import expand_home

IN_VIEW: Final = 0.03
"""Share of a sweep's points that a camera sees at least. A 60° camera sees a tenth of a turning LiDAR's."""

OUT_OF_VIEW: Final = 0.3
"""Ratio of the points in view in two frames from which on one of them is not the camera's."""


class IntrinsicsFile(BaseModel):
    """`intrinsics=FILE`: the head of a `dataset.yaml`, for bags without camera info or without a transform."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: CameraIntrinsics
    T_camera_lidar: Matrix4x4 | None = None
    mask: FilePath | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_direction(cls, document: Any) -> Any:
        return with_direction(document)


@dataclass(frozen=True, slots=True)
class PairMessages:
    """The first messages of a pair, and what was asked for: `intrinsics` a topic or file, `camera_frame` the frame of
    the images.

    Attributes:
        cloud: a sweep in the LiDAR's frame.
    """

    image_topic: str
    image: CameraFrame
    cloud: LidarFrame
    motion: EgoMotion | None
    intrinsics: str | None = None
    camera_frame: str | None = None


@dataclass(frozen=True, slots=True)
class _Lens:
    """Intrinsics and what comes with them; `frame_id` of the CameraInfo, empty if they come from elsewhere."""

    camera: Any
    frame_id: str = ""
    T_camera_lidar: Matrix4 | None = None
    mask: Any = None
    recognitions: tuple[Recognition, ...] = ()


def rig_of_bag(index: BagIndex, pair: PairMessages) -> tuple[Rig, tuple[Recognition, ...]]:
    """The rig of a pair, and what was recognised. Intrinsics come from the `CameraInfo` of the topic `intrinsics`, else
    beside the images, else of the camera's frame; or from the file `intrinsics`. The extrinsic comes from that file,
    else from the transforms.

    Raises:
        SourceError: there are no intrinsics, several, or those of another image size; or there is no extrinsic.
    """
    image, lidar_frame = pair.image, pair.cloud.frame_id
    try:
        lens = _lens_of(index, pair)
    except ValidationError as error:
        raise SourceError(f"{pair.intrinsics}: {describe(error)}") from error
    except (ConfigError, ValueError) as error:
        raise SourceError(f"intrinsics of {index.path}: {error}") from error
    if (image.image.width, image.image.height) != (lens.camera.width, lens.camera.height):
        raise SourceError(
            f"{index.path}: images are {image.image.width} x {image.image.height} px, "
            f"the intrinsics are for {lens.camera.width} x {lens.camera.height} px"
        )
    T_camera_lidar, recognised = lens.T_camera_lidar, lens.recognitions
    if T_camera_lidar is None:
        T_camera_lidar, of_frames = _extrinsic(index, pair, lens)
        recognised = (*recognised, *of_frames)
    if index.transforms.refused:
        text = f"Invalid transforms on /tf_static are left out: {left_out_text(index)}."
        recognised = (*recognised, Recognition("transforms_left_out", text, "warn"))
    T_lidar_ego = index.transform(lidar_frame, pair.motion.frame_id) if pair.motion else None
    rig = Rig(
        pair=re.sub(r"[^A-Za-z0-9_.-]", "_", index.path.stem)[:64],
        camera=lens.camera,
        camera_frame=image.frame_id,
        lidar_frame=lidar_frame,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4) if T_lidar_ego is None else T_lidar_ego,
        mask=lens.mask,
    )
    return rig, recognised


def _extrinsic(index: BagIndex, pair: PairMessages, lens: _Lens) -> tuple[Matrix4, tuple[Recognition, ...]]:
    """T_camera_lidar (4, 4) along the transforms. The camera's frame is the one that was asked for, else that of the
    images; that of the CameraInfo instead, if only the latter is in the tree, or only with it points are in view (a
    driver that names the camera's body in its images)."""
    lidar_frame = pair.cloud.frame_id
    named, recognised = known_frame(index, pair.camera_frame or pair.image.frame_id)
    T = index.transform(named, lidar_frame)
    optical = bare(lens.frame_id)
    T_optical = None
    if pair.camera_frame is None and optical and optical != bare(named):
        T_optical = index.transform(optical, lidar_frame)
    if T is None and T_optical is None:
        raise SourceError(f"{index.path}: {unconnected_text(index, named, lidar_frame)}")
    if T is None or (T_optical is not None and _sees_alone(pair.cloud, lens.camera, T_optical, T)):
        assert T_optical is not None
        why = "the transforms do not lead there" if T is None else "no points lie in the image there"
        text = (
            f"The camera's frame is {optical!a}, that of the CameraInfo: the images name {pair.image.frame_id!a}, but "
            f"{why}. ?camera_frame=NAME says otherwise."
        )
        recognised, named, T = (Recognition("camera_frame", text, "warn"),), optical, T_optical
    changes = index.transforms.changes(named, lidar_frame)
    if changes:
        recognised = (*recognised, Recognition("transform_changes", f"/tf_static: {'; '.join(changes)}.", "warn"))
    return T, recognised


def _sees_alone(cloud: LidarFrame, camera: Any, T: Matrix4, T_other: Matrix4) -> bool:
    """Whether points of a sweep lie in the image at one pose, and hardly any at another one."""
    share, other = (share_in_image(camera, pose, cloud.xyz_m) for pose in (T, T_other))
    return share >= IN_VIEW and other < OUT_OF_VIEW * IN_VIEW


def known_frame(index: BagIndex, frame_id: str) -> tuple[str, tuple[Recognition, ...]]:
    """The frame of this name among the transforms; else the only one with the same last part, because a namespace
    stands before one of the two (`robot/camera`, `camera`)."""
    name, frames = bare(frame_id), index.transforms.frames
    if name in frames:
        return name, ()
    same = [frame for frame in frames if f"/{frame}".endswith(f"/{name}") or f"/{name}".endswith(f"/{frame}")]
    if not name or len(same) != 1:
        return frame_id, ()
    text = f"The frame {name!a} of the messages is taken for {same[0]!a} of the transforms."
    return same[0], (Recognition("frame_namespace", text, "warn"),)


def lidar_frame_of(index: BagIndex, cloud: LidarFrame, requested: str | None) -> tuple[str, Matrix4]:
    """The LiDAR's frame, and its pose (4, 4) in the frame in which a cloud is given. A name that was asked for stands
    for a frame of the cloud that the transforms do not know.

    Raises:
        SourceError: the transforms do not connect the two.
    """
    cloud_frame, _ = known_frame(index, cloud.frame_id)
    lidar_frame = cloud_frame if requested is None else requested
    T_cloud_lidar = index.transform(cloud_frame, lidar_frame)
    if T_cloud_lidar is None and bare(cloud_frame) in index.transforms.frames:
        raise SourceError(f"{index.path}: /tf_static does not connect {cloud_frame!r} and {lidar_frame!r}")
    return lidar_frame, np.eye(4) if T_cloud_lidar is None else T_cloud_lidar


def unconnected_text(index: BagIndex, target: str, source: str) -> str:
    """Why no transforms lead from one frame to the other, and what to do."""
    frames = index.transforms.frames
    listed = ", ".join(ascii(frame) for frame in frames[:LISTED]) + (", ..." if len(frames) > LISTED else "")
    left_out = left_out_text(index)
    return (
        f"/tf_static does not connect {target!r} and {source!r}; "
        "give ?intrinsics=FILE with `camera:` (which may name a camera_info.yaml) and `T_camera_lidar:` as in a "
        f"dataset.yaml, or name the frames with ?camera_frame= and ?lidar_frame=; there: {listed or 'none'}"
        + (f"; left out: {left_out}" if left_out else "")
        + part_of_bag_text(index.path)
    )


def part_of_bag_text(path: Path) -> str:
    """What to open instead of one file of a split bag; empty for another file."""
    is_part = path.is_file() and (path.parent / METADATA).is_file()
    return f"; it is one file of the bag {path.parent}: open that" if is_part else ""


def left_out_text(index: BagIndex) -> str:
    """The invalid transforms of `/tf_static`, with their causes."""
    refused = index.transforms.refused
    return "; ".join(f"{parent!a} -> {child!a}: {error}" for (parent, child), error in refused.items())


def _lens_of(index: BagIndex, pair: PairMessages) -> _Lens:
    rectified = camera_info.is_rectified(pair.image_topic)
    if pair.intrinsics is None or pair.intrinsics in index.infos:
        try:
            info, recognised = _info(index, pair)
            lens = camera_info.intrinsics_of_info(info, rectified=rectified)
        except SourceError as error:
            part = part_of_bag_text(index.path)
            raise SourceError(f"the camera info of {index.path}: {error}; give ?intrinsics=FILE{part}") from error
        if lens.is_adapted:
            text = f"The lens is that of {lens.source}; give ?intrinsics=FILE if the images are not so."
            recognised = (*recognised, Recognition("camera_info_adapted", text))
        return _Lens(camera_of(lens.intrinsics), info.frame_id, recognitions=recognised)
    path = expand_home(pair.intrinsics)
    content, name = load_camera_document(path)
    size = (pair.image.image.width, pair.image.image.height)
    document = IntrinsicsFile.model_validate(with_camera(content, path, name, rectified=rectified, size=size))
    camera = camera_of(document.camera)
    T, mask = document.T_camera_lidar, document.mask
    return _Lens(
        camera,
        T_camera_lidar=None if T is None else rigid_matrix(T, "T_camera_lidar"),
        mask=None if mask is None else load_mask(path.parent / mask, camera),
    )


def _info(index: BagIndex, pair: PairMessages) -> tuple[camera_info.CameraInfoContent, tuple[Recognition, ...]]:
    """The camera info that was asked for, else the one beside the images, of the camera's frame, or the only one."""
    frames = (pair.image.frame_id, bare(pair.image.frame_id))
    topic = pair.intrinsics or camera_info.info_topic(pair.image_topic)
    if topic in index.infos:
        return index.infos[topic].content(frames)
    matching = [infos for infos in index.infos.values() if not infos.frames().isdisjoint(frames)]
    candidates: Sequence[camera_info.CameraInfos] = matching or list(index.infos.values())
    if len(candidates) != 1:
        topics = ", ".join(index.infos) or "none"
        raise SourceError(f"{len(candidates)} camera infos fit; name one with ?intrinsics=/TOPIC; there: {topics}")
    return candidates[0].content(frames)
