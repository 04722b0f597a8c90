"""What a viewer of one pair is expected to draw: extrinsics, projected points, a timeline entry."""

from __future__ import annotations

import numpy as np

from coec.geometry.cameras import Camera, in_image
from coec.geometry.projection import project
from coec.io.viewer_scene import (
    DisplayedPose,
    MissedFrames,
    PoseAxes,
    StreamAges,
    TimelineEntry,
    TimelineFigure,
    TitledExtrinsic,
)
from support.scenes import (
    BOARD_MOVED,
    BOARD_NOMINAL,
)

EXTRINSICS = {
    DisplayedPose.SERVED: TitledExtrinsic(BOARD_MOVED, "served"),
    DisplayedPose.NOMINAL: TitledExtrinsic(BOARD_NOMINAL, "nominal"),
    DisplayedPose.CANDIDATE: TitledExtrinsic(None, "none"),
}


def places(uv_px: np.ndarray) -> set[tuple[float, ...]]:
    """To a millionth of a pixel: half a pixel was added and taken away again."""
    return set(map(tuple, np.round(uv_px, 6).tolist()))


def projected(camera: Camera, T_camera_lidar: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    uv_px, valid = project(camera, xyz_m.astype(np.float64) @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    return uv_px[valid & in_image(camera, uv_px)]


FULL = TimelineEntry(
    pair="front",
    state="suspect",
    level=1,
    why="It may have moved.",
    reasons=("moved",),
    needs=("9 more pairs",),
    provenance="estimated",
    status="accepted",
    percent_complete=40.0,
    candidate=True,
    ages=StreamAges(camera_s=0.1, lidar_s=0.1, ego_s=0.1, answer_s=0.5),
    pair_rate_hz=10.0,
    sync_error_s=0.01,
    correction=PoseAxes(rx_deg=0.1, ry_deg=0.2, rz_deg=0.3, tx_m=0.0, ty_m=0.0, tz_m=0.0),
    sigma=PoseAxes(rx_deg=0.1, ry_deg=0.2, rz_deg=0.3, tx_m=0.0, ty_m=0.0, tz_m=0.0),
    step=PoseAxes(rx_deg=0.1, ry_deg=0.2, rz_deg=0.3, tx_m=0.0, ty_m=0.0, tz_m=0.0),
    figures=(TimelineFigure(name="mi", value=0.5, limit=0.1, passed=True),),
    not_shown=(MissedFrames(stream="camera", cause="frame_id", count=3),),
)
