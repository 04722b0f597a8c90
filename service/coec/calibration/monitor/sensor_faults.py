"""Why a check of the extrinsic went wrong: a bent mount, or data that cannot tell.

Only a bent mount makes the calibration wrong. Every other cause is recognised by what it does to the frames themselves:
a covered lens has no gradients, a lost beam no points, and a wrong clock moves every sweep along the motion of the
vehicle. A cause has to show in most pairs of a check, so that one bad frame is no cause.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import INTRINSICS_OFF, Reason

BLOCK_ROWS, BLOCK_COLUMNS = 18, 32
"""The image is judged in blocks: dirt covers some of them, a covered lens all."""

DARK_LEVEL = 40.0
"""In the dark nine pixels in ten stay below this grey value, of 255."""

FLAT_GRADIENT = 1.0
"""Mean difference of neighbouring grey values below which a block shows nothing: sensor noise and JPEG leave less."""

COVERED_SHARE = 0.7
"""A lens is covered if more than this share of the blocks is flat: sky and road leave more than half of an outdoor
picture textured."""

TEXTURED_GRADIENT = 2.0
"""Blocks with a smaller gradient when the rig was commissioned cannot show dirt."""

DIRTY_RATIO, DIRTY_SHARE = 0.4, 0.012
"""A block looks dirty if its sharpest exposure has less than the first share of the gradient that it had when the rig
was commissioned. A lens is dirty if more than the second share of the textured blocks look dirty, the same ones in
`DIRTY_CHECKS` checks running. See docs/measured.md."""

DIRTY_CHECKS = 3.5
"""Independent checks after which a block is dirty, overlaps not counted: 20 s at the usual pace."""

SAME_PICTURE = 0.01
"""Two exposures are the same picture if their mean absolute difference, over the standard deviation of their grey
values, is below this: a frozen image that was compressed anew has that much noise."""

MOVED_M = 1.0
"""A vehicle that drove so far, in metres, must see another picture."""

STOOD_M, STOOD_RAD = 0.2, 0.01
"""A vehicle that moved and turned by less between two exposures must see the same things in the same places."""

CHANGED = 0.5
"""Two pictures are of different places if the median change of their textured cells exceeds this share of the local
contrast. See docs/measured.md."""

CHANGED_CONTRAST, CHANGED_CELLS = 4.0, 50
"""Least difference between neighbouring cells of a textured one, grey values, and the least number of these."""

BANDS, BAND_RANGE_RAD = 40, (-0.45, -0.05)
"""Bands of elevation in which points are counted: 0.57° each, from -26° to -3°. Each holds a beam of a 64-beam sensor,
and each of these beams hits the ground. Beams above may hit nothing."""

SECTORS = 36
"""Sectors of azimuth of 10°, of the same points."""

LOST_RATIO, LOST_SHARE = 0.2, 0.08
"""A band or sector is lost if no sweep of a check has the first share of the points that it had when the rig was
commissioned. The sensor has lost beams if more than the second share of them is lost: five of 64."""

FEW_POINTS = 30
"""Bands and sectors that had fewer points when the rig was commissioned are not counted."""

OPEN_FIELD_RATIO, OPEN_FIELD_EDGES = 0.2, 60
"""Least range edges of a sweep, as a share of those of the commissioned rig and as a number: with fewer there is
nothing to lay on an image."""


@dataclass(frozen=True, slots=True)
class Cause:
    """A machine-readable code, a sentence that says what is wrong, and a sentence that says what to do about it."""

    code: str
    text: str
    advice: str

    def as_reason(self) -> Reason:
        """The cause as a reason of a verdict or a state of health."""
        return Reason(self.code, self.text)


BENT_MOUNT = Cause(
    "bent_mount",
    "The camera has moved relative to the LiDAR.",
    "Check that the mount is tight; the next accepted window corrects the extrinsic, or `coec calibrate` does.",
)
MOUNT_LOOSE = Cause(
    "mount_loose",
    "The pose of the camera relative to the LiDAR changes from check to check by more than their uncertainty.",
    "Tighten the mount: no single extrinsic is correct while it moves.",
)
LENS_DIRTY = Cause(
    "lens_dirty",
    "Parts of the image have lost their contrast in every exposure.",
    "Clean the lens.",
)
LENS_COVERED = Cause(
    "lens_covered",
    "Most of the image has no contrast.",
    "Uncover the lens.",
)
CAMERA_FROZEN = Cause(
    "camera_frozen",
    "The camera repeats the same image while the vehicle drives.",
    "Restart the camera or its driver.",
)
LIDAR_FROZEN = Cause(
    "lidar_frozen",
    "The LiDAR repeats the same sweep.",
    "Restart the LiDAR or its driver.",
)
BEAMS_LOST = Cause(
    "lidar_beams_lost",
    "Some beams or sectors of the LiDAR return far fewer points than when the rig was commissioned.",
    "Clean the LiDAR, and remove what blocks its view.",
)
EGO_MOTION_WRONG = Cause(
    "ego_motion_wrong",
    "The sweeps fit the images better with a different ego-motion.",
    "Check the scale, sign and frame of the ego-motion (`ego.T_lidar_ego`).",
)
TIME_OFFSET = Cause(
    "time_offset",
    "The sweeps fit the images better with a different time offset between the sensors.",
    "Check the clocks of camera and LiDAR; `coec calibrate --time-offset` measures the offset.",
)
INTRINSICS_WRONG = Cause(
    INTRINSICS_OFF,
    "Other intrinsics explain a window better than those of the rig.",
    "Calibrate the intrinsics again: no extrinsic compensates wrong ones.",
)
DARK = Cause(
    "dark",
    "The images are too dark.",
    "Wait for more light.",
)
OPEN_FIELD = Cause(
    "open_field",
    "There is too little structure within range of the LiDAR.",
    "Wait for buildings, poles or cars within range.",
)

CAUSES = {
    cause.code: cause
    for cause in (
        BENT_MOUNT,
        LENS_COVERED,
        DARK,
        CAMERA_FROZEN,
        LIDAR_FROZEN,
        LENS_DIRTY,
        BEAMS_LOST,
        OPEN_FIELD,
        EGO_MOTION_WRONG,
        TIME_OFFSET,
        INTRINSICS_WRONG,
        MOUNT_LOOSE,
    )
}
"""By code, causes that hide others first."""


@dataclass(frozen=True, slots=True, eq=False)
class PictureFacts:
    """What one image shows of the camera itself.

    Attributes:
        gradient: (BLOCK_ROWS, BLOCK_COLUMNS) mean absolute difference of neighbouring grey values.
        bright: grey value below which nine pixels in ten lie.
        thumbnail: float32, mean grey values of small cells.
        digest: of the thumbnail.
    """

    gradient: NDArray[np.float64]
    bright: float
    thumbnail: NDArray[np.float32]
    digest: int


@dataclass(frozen=True, slots=True, eq=False)
class SweepFacts:
    """What one sweep shows of the LiDAR itself.

    Attributes:
        bands: (BANDS,) points by elevation.
        sectors: (SECTORS,) the same points by azimuth.
        range_edges: range edges of the sweep.
        digest: of all its points.
    """

    bands: NDArray[np.int64]
    sectors: NDArray[np.int64]
    range_edges: int
    digest: int


@dataclass(frozen=True, slots=True, eq=False)
class SceneFacts:
    """What one pair shows of the sensors themselves; `speed_mps` and `turn_radps` are speed and rate of turn of the
    vehicle by its odometry, None if unknown."""

    stamp_ns: int
    picture: PictureFacts
    sweep: SweepFacts
    speed_mps: float | None
    turn_radps: float | None


@dataclass(frozen=True, slots=True, eq=False)
class SceneBaseline:
    """Medians of what the pairs of a commissioned rig show; see `SceneFacts`."""

    gradient: NDArray[np.float64]
    bands: NDArray[np.float64]
    sectors: NDArray[np.float64]
    range_edges: float


def scene_baseline(scenes: Sequence[SceneFacts]) -> SceneBaseline:
    """Medians over the pairs that commissioned a rig."""
    return SceneBaseline(
        gradient=np.median([scene.picture.gradient for scene in scenes], axis=0),
        bands=np.median([scene.sweep.bands for scene in scenes], axis=0),
        sectors=np.median([scene.sweep.sectors for scene in scenes], axis=0),
        range_edges=float(np.median([scene.sweep.range_edges for scene in scenes])),
    )


def data_causes(scenes: Sequence[SceneFacts], baseline: SceneBaseline | None) -> tuple[Cause, ...]:
    """Every cause in the frames themselves not to believe a check of them, those that hide others first. Lost beams can
    be seen only with a commissioned rig, dirt only over several checks."""
    gradient = np.array([scene.picture.gradient for scene in scenes])
    causes = []
    dark = float(np.median([scene.picture.bright for scene in scenes])) < DARK_LEVEL
    if dark:
        causes.append(DARK)
    elif float((gradient.max(axis=0) < FLAT_GRADIENT).mean()) > COVERED_SHARE:
        causes.append(LENS_COVERED)
    if _is_frozen(scenes):
        causes.append(CAMERA_FROZEN)
    if _most(a.sweep.digest == b.sweep.digest for a, b in pairwise(scenes)):
        causes.append(LIDAR_FROZEN)
    if _moves_unnoticed(scenes):
        causes.append(EGO_MOTION_WRONG)
    if (
        baseline is not None
        and max(
            _lost(np.array([scene.sweep.bands for scene in scenes]), baseline.bands),
            _lost(np.array([scene.sweep.sectors for scene in scenes]), baseline.sectors),
        )
        > LOST_SHARE
    ):
        causes.append(BEAMS_LOST)
    edges = float(np.median([scene.sweep.range_edges for scene in scenes]))
    few = OPEN_FIELD_EDGES if baseline is None else max(OPEN_FIELD_EDGES, OPEN_FIELD_RATIO * baseline.range_edges)
    if edges < few and not causes:
        causes.append(OPEN_FIELD)
    return tuple(causes)


def dirty_blocks(scenes: Sequence[SceneFacts], baseline: SceneBaseline) -> tuple[tuple[int, ...], int]:
    """The numbers of the blocks of the image that look dirty in all these pairs, and how many blocks could be dirty."""
    textured = baseline.gradient >= TEXTURED_GRADIENT
    sharpest = np.max([scene.picture.gradient for scene in scenes], axis=0)
    dirty = textured & (sharpest < DIRTY_RATIO * baseline.gradient)
    return tuple(int(block) for block in np.flatnonzero(dirty)), int(textured.sum())


def _lost(counts: NDArray[np.int64], usual: NDArray[np.float64]) -> float:
    """Share of the usual directions in which no sweep has `LOST_RATIO` of its usual points."""
    counted = usual >= FEW_POINTS
    if not counted.any():
        return 0.0
    return float((counts.max(axis=0) < LOST_RATIO * usual)[counted].mean())


def _most(facts: Iterable[bool]) -> bool:
    values = list(facts)
    return 2 * sum(values) > len(values)


def _is_frozen(scenes: Sequence[SceneFacts]) -> bool:
    """Whether most successive pictures are identical, whatever the vehicle does, or the same while it drove."""
    successive = list(pairwise(scenes))
    # A picture of one grey value, as of darkness, may repeat itself. Any other has noise.
    if _most(a.picture.digest == b.picture.digest and a.picture.thumbnail.std() > 0.0 for a, b in successive):
        return True
    return _most(_same_picture(a, b) for a, b in successive if _moved(a, b))


def _moves_unnoticed(scenes: Sequence[SceneFacts]) -> bool:
    """Whether the odometry says that the vehicle stands, and most successive pictures are of different places."""
    successive = list(pairwise(scenes))
    return all(_stood(a, b) for a, b in successive) and _most(
        picture_change(a.picture.thumbnail, b.picture.thumbnail) > CHANGED for a, b in successive
    )


def _stood(a: SceneFacts, b: SceneFacts) -> bool:
    """Whether the vehicle hardly moved between two exposures by its odometry."""
    if a.speed_mps is None or b.speed_mps is None or a.turn_radps is None or b.turn_radps is None:
        return False
    elapsed_s = (b.stamp_ns - a.stamp_ns) * 1e-9
    moved_m, turned_rad = max(a.speed_mps, b.speed_mps) * elapsed_s, max(a.turn_radps, b.turn_radps) * elapsed_s
    return moved_m < STOOD_M and turned_rad < STOOD_RAD


def picture_change(before: NDArray[np.float32], after: NDArray[np.float32]) -> float:
    """How far the cells of two thumbnails (rows, columns) differ where the first has texture: the median change, in
    units of the difference between neighbouring cells. 0 if too few cells have texture, or the shapes differ."""
    if before.shape != after.shape or min(before.shape) < 2:
        return 0.0
    contrast = np.maximum(np.abs(np.diff(before, axis=0))[:, :-1], np.abs(np.diff(before, axis=1))[:-1])
    textured = contrast > max(CHANGED_CONTRAST, float(np.median(contrast)))
    if np.count_nonzero(textured) < CHANGED_CELLS:
        return 0.0
    change = (after - before)[:-1, :-1][textured]
    # Another exposure makes all cells brighter alike.
    return float(np.median(np.abs(change - np.median(change)) / contrast[textured]))


def _moved(a: SceneFacts, b: SceneFacts) -> bool:
    """Whether the vehicle drove between two frames. Unknown motion counts as driving, because even a standing camera
    has noise."""
    if a.speed_mps is None or b.speed_mps is None:
        return True
    return min(a.speed_mps, b.speed_mps) * (b.stamp_ns - a.stamp_ns) * 1e-9 > MOVED_M


def _same_picture(a: SceneFacts, b: SceneFacts) -> bool:
    one, other = a.picture, b.picture
    if one.digest == other.digest:
        return True
    if one.thumbnail.shape != other.thumbnail.shape or a.speed_mps is None:
        return False
    contrast = max(float(one.thumbnail.std()), 1.0)
    return float(np.abs(one.thumbnail - other.thumbnail).mean()) < SAME_PICTURE * contrast
