"""The rig of a pair in a bag."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from coec.adapters.files.home import expand_home
from coec.adapters.files.rig import camera_of, load_mask, rigid_matrix
from coec.adapters.ros.camera_info import (
    CameraInfoContent,
    CameraInfoIntrinsics,
    info_of_yaml,
    info_topic,
    intrinsics_of_info,
    is_rectified,
)
from coec.adapters.ros.transforms import bare
from coec.calibration.types import CameraFrame, EgoMotion, Rig
from coec.config import CameraIntrinsics, FilePath, Matrix4x4, describe, load_yaml
from coec.errors import ConfigError, SourceError
from coec.sources.bag.index import BagIndex

_PATH: TypeAdapter[Path] = TypeAdapter(FilePath)


def with_ros_camera_info(document: Any, path: Path, rectified: bool) -> Any:
    """The document of a file with a `camera:`, in which that may be a `camera_info.yaml` of ROS: its content, or its
    path. The whole file may be one, too. Any other document is returned as it is.

    Raises:
        SourceError: it is a `CameraInfo` that describes no lens.
        ConfigError: the named file cannot be read.
        ValidationError: its name is no path.
    """
    whole = info_of_yaml(document) is not None
    camera = document if whole else document.get("camera") if isinstance(document, dict) else None
    if isinstance(camera, str):
        path = path.parent / _PATH.validate_python(camera)
        if not path.is_file():
            raise SourceError(f"camera: there is no file {path}; give the lens here, or name a camera_info.yaml")
        camera = load_yaml(path)
    try:
        info = info_of_yaml(camera)
        if info is None:
            return document
        intrinsics = intrinsics_of_info(info, rectified=rectified).intrinsics.model_dump(exclude_none=True)
    except SourceError as error:
        raise SourceError(f"{path}, a CameraInfo: {error}") from error
    return {"camera": intrinsics} if whole else {**document, "camera": intrinsics}


class IntrinsicsFile(BaseModel):
    """`intrinsics=FILE`: the head of a `dataset.yaml`, for bags without camera info or without a transform."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: CameraIntrinsics
    T_camera_lidar: Matrix4x4 | None = None
    mask: FilePath | None = None


def rig_of_bag(
    index: BagIndex,
    intrinsics: str | None,
    image_topic: str,
    image: CameraFrame,
    lidar_frame_id: str,
    motion: EgoMotion | None,
) -> Rig:
    """The rig of a pair. Intrinsics come from the `CameraInfo` of the topic `intrinsics`, else beside the images, else
    of the camera's frame; or from the YAML file `intrinsics`. The extrinsic comes from that file, else from
    `/tf_static`.

    Raises:
        SourceError: there are no intrinsics, several, or those of another image size; or there is no extrinsic.
    """
    camera_frame, lidar_frame = bare(image.frame_id), bare(lidar_frame_id)
    mask = None
    T_camera_lidar = index.transform(camera_frame, lidar_frame)
    try:
        if intrinsics is None or intrinsics in index.infos:
            info = _info(index, intrinsics, camera_frame, image_topic)
            camera = camera_of(_lens(index, info, image_topic).intrinsics)
        else:
            path = expand_home(intrinsics)
            document = IntrinsicsFile.model_validate(
                with_ros_camera_info(load_yaml(path), path, is_rectified(image_topic))
            )
            camera = camera_of(document.camera)
            if document.T_camera_lidar is not None:
                T_camera_lidar = rigid_matrix(document.T_camera_lidar, "T_camera_lidar")
            if document.mask is not None:
                mask = load_mask(path.parent / document.mask, camera)
    except ValidationError as error:
        raise SourceError(f"{intrinsics}: {describe(error)}") from error
    except (ConfigError, ValueError) as error:
        raise SourceError(f"intrinsics of {index.path}: {error}") from error
    if T_camera_lidar is None:
        raise SourceError(
            f"{index.path}: /tf_static does not connect {camera_frame!r} and {lidar_frame!r}; "
            "give ?intrinsics=FILE with `camera:` (which may name a camera_info.yaml) and `T_camera_lidar:` as in a "
            "dataset.yaml"
        )
    if (image.image.width, image.image.height) != (camera.width, camera.height):
        raise SourceError(
            f"{index.path}: images are {image.image.width} x {image.image.height} px, "
            f"the intrinsics are for {camera.width} x {camera.height} px"
        )
    T_lidar_ego = index.transform(lidar_frame, motion.frame_id) if motion else None
    return Rig(
        pair=re.sub(r"[^A-Za-z0-9_.-]", "_", index.path.stem)[:64],
        camera=camera,
        camera_frame=image.frame_id,
        lidar_frame=lidar_frame_id,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4) if T_lidar_ego is None else T_lidar_ego,
        mask=mask,
    )


def _lens(index: BagIndex, info: CameraInfoContent, image_topic: str) -> CameraInfoIntrinsics:
    try:
        return intrinsics_of_info(info, rectified=is_rectified(image_topic))
    except SourceError as error:
        raise SourceError(f"the camera info of {index.path}: {error}; give ?intrinsics=FILE") from error


def _info(index: BagIndex, requested: str | None, camera_frame: str, image_topic: str) -> CameraInfoContent:
    """The camera info that was asked for, else the one beside the images, of the camera's frame, or the only one."""
    if requested is not None:
        return index.infos[requested]
    of_images = index.infos.get(info_topic(image_topic))
    if of_images is not None:
        return of_images
    matching = [info for info in index.infos.values() if bare(info.frame_id) == camera_frame]
    candidates = matching or list(index.infos.values())
    if len(candidates) != 1:
        topics = ", ".join(index.infos) or "none"
        raise SourceError(
            f"{index.path}: {len(candidates)} camera infos fit; "
            f"name one with ?intrinsics=/TOPIC, or give ?intrinsics=FILE; there: {topics}"
        )
    return candidates[0]
