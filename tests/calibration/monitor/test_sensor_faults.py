"""Causes told apart: a recorded drive with one thing changed at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.baseline import Baseline
from coec.calibration.commissioning import learn_accuracy
from coec.calibration.monitor.change_detector import (
    MonitorOutcome,
    MonitorState,
    after_observation,
    alarm_levels,
    diagnose,
)
from coec.calibration.monitor.check import gather
from coec.calibration.monitor.check_verdict import UNCOMMISSIONED, observe
from coec.calibration.monitor.sensor_faults import (
    BANDS,
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    CAUSES,
    SECTORS,
    PictureFacts,
    SceneBaseline,
    SceneFacts,
    SweepFacts,
    data_causes,
    dirty_blocks,
    scene_baseline,
)
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import DepthModel, LidarFrame, Silence, Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, MonitorConfig
from coec.geometry import se3
from coec.io.depth.depth_maps import CachedDepth, open_depth
from coec.io.images import GreyImages
from coec.io.recordings import window_cutting
from support import degradations

LEVELS = alarm_levels(MonitorConfig())
Change = Callable[[Window, np.random.Generator], Window]


@dataclass(frozen=True)
class Drive:
    """Five pairs of a drive, and a baseline from five others."""

    window: Window
    depth: DepthModel
    baseline: Baseline


@pytest.fixture(scope="module")
def drive(sample_data: Path) -> Drive:
    whole = window_cutting.load_window(
        f"kitti360:{sample_data / 'kitti360'}?camera=image_00", None, 25, lambda *_: None
    ).window
    depth = CachedDepth(open_depth(DepthConfig(model="stereo"), LimitsConfig()), 10)
    learned = replace(whole, pairs=whole.pairs[::2])
    evidence = gather(prepare_window_data(learned, depth, GreyImages(LimitsConfig()), CalibrationConfig(), Silence()))
    right = whole.rig.T_camera_lidar_nominal
    rotation, pose = learn_accuracy(evidence, right)
    baseline = Baseline(
        pair=whole.rig.pair, T_camera_lidar=right, rotation=rotation, pose=pose, dof=3, limits={},
        monitor=replace(UNCOMMISSIONED, min_edges_per_pair=10.0), scene=scene_baseline(evidence.scenes),
        false_alarm_rate=0.01, windows=1, pairs=5, detected={}, sensors={}, depth_identity="", config_hash="",
    )  # fmt: skip
    return Drive(replace(whole, pairs=whole.pairs[1::2]), depth, baseline)


def turned(degrees: tuple[float, float, float]) -> Change:
    def change(window: Window, rng: np.random.Generator) -> Window:
        del rng
        xi = np.array([*(radians(angle) for angle in degrees), 0.0, 0.0, 0.0])
        return replace(window, T_camera_lidar_start=se3.perturb(window.T_camera_lidar_start, xi))

    return change


def late_camera_by_a_period(window: Window, rng: np.random.Generator) -> Window:
    return degradations.late_camera(window, rng, 100_000_000)


def ground_alone(window: Window, rng: np.random.Generator) -> Window:
    """Nothing stands on the plain; the sensor is 1.7 m above it."""
    del rng

    def selected(sweep: LidarFrame, index: int) -> NDArray[np.intp]:
        del index
        return np.flatnonzero(sweep.xyz_m[:, 2] < -1.4)

    return degradations.with_points(window, selected)


def unchanged(window: Window, rng: np.random.Generator) -> Window:
    del rng
    return window


def states(drive: Drive, change: Change, checks: int = 6) -> list[MonitorState]:
    """What looks at the changed drive add up to, each at pairs that were not seen before."""
    changed = change(drive.window, np.random.default_rng(1))
    seen = observe(changed, drive.depth, GreyImages(LimitsConfig()), CalibrationConfig(), drive.baseline)
    state, after = MonitorState(), []
    for number in range(checks):
        fresh = tuple(stamp + number * 10**12 for stamp in seen.pair_stamps_ns)
        state = after_observation(state, replace(seen, pair_stamps_ns=fresh), LEVELS)
        after.append(state)
    return after


class TestScenarios:
    @pytest.mark.parametrize(
        ("change", "code"),
        [
            (turned((0.7, -0.5, 0.5)), "bent_mount"),
            pytest.param(turned((0.0, 0.6, 0.0)), "bent_mount", marks=pytest.mark.slow),
            (degradations.dirt, "lens_dirty"),
            (degradations.covered_lens, "lens_covered"),
            (degradations.frozen_camera, "camera_frozen"),
            (degradations.sixteen_beams, "lidar_beams_lost"),
            pytest.param(degradations.half_the_azimuths, "lidar_beams_lost", marks=pytest.mark.slow),
            (degradations.wrong_ego_motion, "ego_motion_wrong"),
            pytest.param(degradations.fast_ego_motion, "ego_motion_wrong", marks=pytest.mark.slow),
            (degradations.late_camera, "time_offset"),
            (late_camera_by_a_period, "time_offset"),
            (degradations.night, "dark"),
            (ground_alone, "open_field"),
        ],
    )
    def test_has_its_own_reason(self, drive: Drive, change: Change, code: str) -> None:
        cause = diagnose(states(drive, change)[-1])
        assert cause is not None
        assert cause.code == code

    @pytest.mark.parametrize(
        "change",
        [
            unchanged,
            pytest.param(degradations.rain_drops, marks=pytest.mark.slow),
            degradations.blown_out_sky,
            degradations.boxes_in_the_image,
            degradations.unorganised,
            degradations.clusters_moved_in_the_cloud,
        ],
    )
    def test_what_happens_on_every_drive_is_no_cause(self, drive: Drive, change: Change) -> None:
        state = states(drive, change)[-1]
        assert diagnose(state) is None
        assert state.outcome is MonitorOutcome.CLEAR

    @pytest.mark.parametrize("change", [turned((5.0, -5.0, 3.0)), degradations.images_of_other_frames])
    def test_what_no_check_can_explain_is_never_certain_and_never_clear(self, drive: Drive, change: Change) -> None:
        after = states(drive, change, checks=30)
        assert {state.outcome for state in after[2:]} <= {MonitorOutcome.AT_ODDS, MonitorOutcome.SUSPECT}
        assert diagnose(after[-1]) is None


def facts(stamp_ns: int = 0, **other: object) -> SceneFacts:
    """A sharp, bright picture of a full scene."""
    picture = PictureFacts(
        gradient=np.full((BLOCK_ROWS, BLOCK_COLUMNS), 10.0),
        bright=180.0,
        thumbnail=np.random.default_rng(stamp_ns).normal(100, 40, (6, 8)).astype(np.float32),
        digest=stamp_ns,
    )
    sweep = SweepFacts(np.full(BANDS, 400, np.int64), np.full(SECTORS, 400, np.int64), 1000, digest=stamp_ns)
    return changed(SceneFacts(stamp_ns, picture, sweep, speed_mps=8.0, turn_radps=0.0), **other)


def changed(scene: SceneFacts, **other: object) -> SceneFacts:
    """With other figures, of whichever part has them."""
    of_sweep = {"digest": other.pop("sweep_digest")} if "sweep_digest" in other else {}
    of_picture = {name: value for name, value in other.items() if hasattr(scene.picture, name)}
    of_sweep |= {name: value for name, value in other.items() if hasattr(scene.sweep, name) and name not in of_picture}
    of_scene = {name: value for name, value in other.items() if name not in of_picture | of_sweep}
    picture = replace(scene.picture, **of_picture)  # type: ignore[arg-type]
    sweep = replace(scene.sweep, **of_sweep)  # type: ignore[arg-type]
    return replace(scene, picture=picture, sweep=sweep, **of_scene)  # type: ignore[arg-type]


STILL = np.random.default_rng(5).normal(100, 40, (40, 60)).astype(np.float32)


def moving(second: int) -> NDArray[np.float32]:
    """The thumbnail of a vehicle that drives: another place every second."""
    return np.random.default_rng(100 + second).normal(100, 40, (40, 60)).astype(np.float32)


def with_lorry(thumbnail: NDArray[np.float32], second: int) -> NDArray[np.float32]:
    """With something grey in a third of the picture, elsewhere every second."""
    covered = thumbnail.copy()
    covered[:, 8 * second : 8 * second + 20] = 90.0
    return covered


def drive_of(**other: object) -> list[SceneFacts]:
    return [facts(second * 1_000_000_000, **other) for second in range(5)]


def usual() -> SceneBaseline:
    return scene_baseline(drive_of())


class TestFacts:
    def test_nothing_wrong(self) -> None:
        assert data_causes(drive_of(), usual()) == ()
        assert data_causes(drive_of(), None) == ()

    @pytest.mark.fault("a driver repeats its last frame, and odometry says 0", "the sensor is named as frozen")
    def test_a_sensor_that_repeats_itself_to_the_bit_is_frozen_whatever_the_vehicle_does(self) -> None:
        for speed_mps in (0.0, 8.0, None):
            same = drive_of(digest=7, speed_mps=speed_mps)
            assert [cause.code for cause in data_causes(same, None)] == ["camera_frozen"]
            same = drive_of(sweep_digest=7, speed_mps=speed_mps)
            assert [cause.code for cause in data_causes(same, None)] == ["lidar_frozen"]

    def test_a_picture_of_one_grey_value_may_repeat_itself(self) -> None:
        black = drive_of(digest=7, speed_mps=0.0, thumbnail=np.zeros((6, 8), np.float32))
        assert data_causes(black, None) == ()

    @pytest.mark.fault("odometry says 0 while the vehicle drives", "`ego_motion_wrong`; it is not taken for standing")
    def test_pictures_that_change_while_odometry_says_0(self) -> None:
        scenes = [facts(second * 1_000_000_000, speed_mps=0.0, thumbnail=moving(second)) for second in range(6)]
        assert [cause.code for cause in data_causes(scenes, None)] == ["ego_motion_wrong"]
        turning = [replace(scene, turn_radps=0.3) for scene in scenes]
        assert data_causes(turning, None) == (), "a vehicle that turns on the spot sees something else, too"
        brighter = [facts(n * 1_000_000_000, speed_mps=0.0, thumbnail=STILL + 5.0 * n) for n in range(6)]
        rng = np.random.default_rng(0)
        still = [changed(one, thumbnail=one.picture.thumbnail + rng.normal(0, 1, STILL.shape)) for one in brighter]
        lorry = [with_lorry(one.picture.thumbnail, n) for n, one in enumerate(still)]
        passing = [changed(one, thumbnail=thumbnail) for one, thumbnail in zip(still, lorry, strict=True)]
        assert data_causes(passing, None) == (), "traffic passes a vehicle that stands"

    def test_one_blurred_picture_is_no_dirt(self) -> None:
        spot = np.full((BLOCK_ROWS, BLOCK_COLUMNS), 10.0)
        spot[:3] = 1.0
        scenes = drive_of()
        blocks = BLOCK_ROWS * BLOCK_COLUMNS
        assert dirty_blocks([changed(scenes[0], gradient=spot), *scenes[1:]], usual()) == ((), blocks)
        dirty = dirty_blocks([changed(scene, gradient=spot) for scene in scenes], usual())
        assert dirty == (tuple(range(3 * BLOCK_COLUMNS)), blocks)

    def test_what_never_had_contrast_cannot_lose_it(self) -> None:
        sky = np.full((BLOCK_ROWS, BLOCK_COLUMNS), 10.0)
        sky[:3] = 1.0
        assert dirty_blocks(drive_of(gradient=sky / 5.0), scene_baseline(drive_of(gradient=sky)))[1] == (
            (BLOCK_ROWS - 3) * BLOCK_COLUMNS
        )

    def test_a_beam_that_is_missing_once_is_not_lost(self) -> None:
        holes = np.full(BANDS, 400, np.int64)
        holes[:6] = 0
        scenes = drive_of()
        assert data_causes([changed(scenes[0], bands=holes), *scenes[1:]], usual()) == ()
        lost = data_causes([changed(scene, bands=holes) for scene in scenes], usual())
        assert [cause.code for cause in lost] == ["lidar_beams_lost"]

    def test_every_cause_is_listed_under_its_code(self) -> None:
        assert all(code == cause.code == cause.as_reason().code for code, cause in CAUSES.items())
        assert len(CAUSES) == 12
