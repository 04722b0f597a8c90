"""Two cues in one objective, and the calibration that rests on it, on a street with a known truth."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.objective.edges import EdgeCue
from coec.calibration.objective.fused import OTHER_POSES, FusedObjective, Fusion, Scale
from coec.calibration.objective.mutual_information import (
    COLUMNS,
    ROWS,
    MutualInformation,
    SearchBox,
    build_mutual_information,
    distance_and_depth,
)
from coec.calibration.pipeline import calibrate
from coec.calibration.search.global_search import sample_reach
from coec.calibration.solver import SAME_BASIN_RAD
from coec.calibration.types import (
    MOUNT_RAD,
    CameraFrame,
    Decision,
    DepthMap,
    DepthModel,
    EncodedImage,
    Estimate,
    FramePair,
    ImageFormat,
    Matrix4,
    Silence,
    Window,
)
from coec.config import CalibrationConfig, LimitsConfig, ObjectiveConfig, SearchConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment, significances
from coec.geometry.edges.charts import charted_significances
from coec.io.images import GreyImages

FUSED = CalibrationConfig(objective=ObjectiveConfig(kind="fused"))
SIX = CalibrationConfig(objective=ObjectiveConfig(kind="fused"), search=SearchConfig(dof=6))
INTENSITY = CalibrationConfig(objective=ObjectiveConfig(kind="intensity"))
GREY = GreyImages(LimitsConfig())
REACH = SearchBox(np.radians(28.0), 0.0)


class Noise:
    """A network that tells nothing: its depth is drawn at random, the same for the same frame."""

    identity = "noise"

    def infer(self, frame: CameraFrame) -> DepthMap:
        rng = np.random.default_rng(frame.stamp_ns % 2**32)
        return DepthMap(rng.random((80, 80)).astype(np.float32))


def mutual_information_of(window: Window, depth: DepthModel) -> MutualInformation:
    return build_mutual_information(
        [
            distance_and_depth(
                compensate(pair, window.rig, enabled=True), depth.infer(pair.camera), window.T_camera_lidar_start
            )
            for pair in window.pairs
        ],
        window.rig,
        window.T_camera_lidar_start,
        REACH,
        ObjectiveConfig(),
    )


@pytest.fixture(scope="module")
def depth_cue(sharp_street: Window, stereo: DepthModel) -> MutualInformation:
    return mutual_information_of(sharp_street, stereo)


@pytest.fixture(scope="module")
def fusion(sharp_street: Window, sharp_edges: EdgeCue, depth_cue: MutualInformation) -> Fusion:
    return Fusion(sharp_edges, depth_cue, sharp_street.T_camera_lidar_start, REACH)


@pytest.fixture(scope="module")
def fused(fusion: Fusion) -> FusedObjective:
    return fusion.settling(fusion.edges)[0]


@pytest.fixture(scope="module")
def few(sharp_street: Window) -> Window:
    """Half of its pairs, for everything that is solved."""
    return replace(sharp_street, pairs=sharp_street.pairs[:5])


def solve(window: Window, depth: DepthModel, config: CalibrationConfig = FUSED) -> Estimate:
    return calibrate(window, depth, GREY, config, Silence())


def from_start(window: Window, seed: int, turn_deg: float, shift_m: float = 0.0) -> Window:
    """The window with a start so far from the truth, in directions drawn at random."""
    turn, shift = np.random.default_rng(seed).normal(size=(2, 3))
    xi = np.concatenate([np.radians(turn_deg) * turn / np.linalg.norm(turn), shift_m * shift / np.linalg.norm(shift)])
    return replace(window, T_camera_lidar_start=se3.perturb(window.rig.T_camera_lidar_nominal, xi))


def error_deg(estimate: Estimate) -> float:
    """Angle to the truth, which is the nominal calibration of the street."""
    return float(np.degrees(np.linalg.norm(estimate.correction[:3])))


def is_accounted_for(estimate: Estimate) -> bool:
    """Accepted, or with reasons that have words."""
    if estimate.verdict.decision is Decision.ACCEPTED:
        return not estimate.verdict.reasons
    return len(estimate.verdict.reasons) > 0 and all(reason.text for reason in estimate.verdict.reasons)


# ------------------------------------------------------------------------------------------------- the objective
def z_of(edges: EdgeFrames, pose: Matrix4) -> float:
    at = frame_alignment(edges, pose)
    return float(at.strength.sum() / np.sqrt(at.square.sum()))


@pytest.mark.parametrize("turn_deg", [0.0, 0.4, 3.0, 20.0])
def test_the_score_is_the_sum_of_both_cues_in_their_own_standard_deviations(
    sharp_street: Window,
    sharp_edges: EdgeCue,
    depth_cue: MutualInformation,
    fusion: Fusion,
    turn_deg: float,
) -> None:
    pose = from_start(sharp_street, 1, turn_deg).T_camera_lidar_start
    others = sample_reach(sharp_street.T_camera_lidar_start, REACH, OTHER_POSES)
    other_mi = np.array([depth_cue.evaluate(other).score for other in others])
    of_depth = (depth_cue.evaluate(pose).score - other_mi.mean()) / other_mi.std()
    for objective, edges in zip(fusion.settling(sharp_edges), (sharp_edges.whole, sharp_edges.sharp), strict=True):
        z = significances(edges, others)
        expected = (z_of(edges, pose) - z.mean()) / z.std() + of_depth
        assert objective.evaluate(pose).score == pytest.approx(expected, abs=1e-6)
    band_z = np.mean([charted_significances(chart, others) for chart in sharp_edges.charts], axis=0)
    for objective, band in zip(fusion.ranking, (sharp_edges.bands[1], sharp_edges.bands[0]), strict=True):
        expected = (z_of(band, pose) - band_z.mean()) / band_z.std() + of_depth
        assert objective.evaluate(pose).score == pytest.approx(expected, abs=1e-6)


def test_basins_are_ranked_from_coarse_to_fine_and_settled_on_the_sharpest_edges(
    sharp_edges: EdgeCue, fusion: Fusion
) -> None:
    assert [objective.step_rad for objective in fusion.ranking] == [*reversed(sharp_edges.band_blur_rad[:-1])]
    whole, sharp = fusion.settling(fusion.edges)
    assert sharp.step_rad == whole.step_rad == sharp_edges.blur_rad <= fusion.ranking[-1].step_rad


def test_a_score_that_does_not_vary_is_no_division_by_zero() -> None:
    assert Scale.of(np.full(5, 3.0)).standard(3.0) == 0.0
    assert Scale.of(np.array([1.0, 3.0])).standard(4.0) == pytest.approx(2.0)


def test_the_frames_average_to_the_score(sharp_street: Window, fused: FusedObjective) -> None:
    for turn_deg in (0.0, 1.0, 15.0):
        at = fused.evaluate(from_start(sharp_street, 2, turn_deg).T_camera_lidar_start)
        assert at.frame_scores.shape == (len(sharp_street.pairs),)
        assert at.frame_scores.mean() == pytest.approx(at.score)


def test_its_cells_sum_to_the_objective_but_for_a_constant(sharp_street: Window, fused: FusedObjective) -> None:
    truth = sharp_street.T_camera_lidar_start
    cells = fused.cells(truth)
    assert cells.at(truth[None])[0].shape == (len(sharp_street.pairs), COLUMNS * ROWS + 1)
    poses = [truth, *sample_reach(truth, SearchBox(np.radians(1.0), 0.0), 4)]
    rest = [cells.at(pose[None])[0].sum(axis=1).mean() - fused.evaluate(pose).score for pose in poses]
    np.testing.assert_allclose(rest, rest[0], atol=1e-9)
    in_front = cells.points.p_camera[:, 2] > 0.0
    assert in_front.mean() > 0.9


def test_what_is_reported_about_depth_is_what_the_depth_cue_reports(
    sharp_street: Window, depth_cue: MutualInformation, fused: FusedObjective
) -> None:
    pose = from_start(sharp_street, 3, 2.0).T_camera_lidar_start
    alone, both = depth_cue.evaluate(pose), fused.evaluate(pose)
    assert (both.mi, both.overlap, both.points_in_view) == (alone.mi, alone.overlap, alone.points_in_view)


def test_the_truth_stands_out_and_other_poses_are_spread_around_nought(sharp_street: Window, fusion: Fusion) -> None:
    truth, others = sharp_street.T_camera_lidar_start, sample_reach(sharp_street.T_camera_lidar_start, REACH, 64)
    depth = [fusion.depth_contrast(pose) for pose in others]
    assert np.mean(depth) == pytest.approx(0.0, abs=1e-6)
    assert np.std(depth) == pytest.approx(1.0, abs=1e-6)
    # Counted in deviations of the charts, of which there are two to three bands.
    for edges in fusion.contrasts_by_kind(others):
        assert abs(np.mean(edges)) < 0.5
        assert 0.7 < np.std(edges) < 1.3
    assert fusion.edge_contrast(truth) > max(fusion.edge_contrasts(others))
    by_kind = np.ravel(fusion.contrasts_by_kind(truth[None]))
    assert fusion.rank(truth) == pytest.approx(np.linalg.norm([*by_kind, fusion.depth_contrast(truth)]))
    assert fusion.rank(truth) > max(fusion.rank(pose) for pose in others)


def test_contrasts_about_a_pose_are_the_same_from_any_start(
    sharp_street: Window, sharp_edges: EdgeCue, depth_cue: MutualInformation
) -> None:
    pose = sharp_street.rig.T_camera_lidar_nominal
    starts = (from_start(sharp_street, seed, 8.0).T_camera_lidar_start for seed in (1, 2, 3))
    contrasts = {Fusion(sharp_edges, depth_cue, start, REACH).about(pose).edge_contrast(pose) for start in starts}
    assert len(contrasts) == 1


def test_depth_that_does_not_vary_with_the_pose_leaves_the_edges_to_decide(
    sharp_street: Window, sharp_edges: EdgeCue
) -> None:
    """One value everywhere: no mutual information at any pose, and no division by its deviation."""

    class Blank:
        identity = "blank"

        def infer(self, frame: CameraFrame) -> DepthMap:
            del frame
            return DepthMap(np.ones((40, 40), np.float32))

    blank, start = mutual_information_of(sharp_street, Blank()), sharp_street.T_camera_lidar_start
    alone = Fusion(sharp_edges, blank, start, REACH).settling(sharp_edges)[0]
    score = alone.evaluate(sharp_street.T_camera_lidar_start).score
    assert np.isfinite(score)
    assert score > alone.evaluate(from_start(sharp_street, 4, 3.0).T_camera_lidar_start).score


# ----------------------------------------------------------------------------------------------- the calibration
@pytest.fixture(scope="module")
def informed(few: Window, stereo: DepthModel) -> Estimate:
    """From a start five degrees away, with depth that is right."""
    return solve(from_start(few, 8, 5.0), stereo)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_start_twenty_five_degrees_away_comes_back(few: Window, stereo: DepthModel, seed: int) -> None:
    estimate = solve(from_start(few, seed, 25.0), stereo)
    assert error_deg(estimate) < 0.5
    assert is_accounted_for(estimate)
    assert estimate.optimum.score > estimate.optimum.score_at_start
    assert np.abs(estimate.correction[3:]).max() < 0.01


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_start_fifteen_degrees_and_thirty_centimetres_away_comes_back(
    few: Window, stereo: DepthModel, seed: int
) -> None:
    estimate = solve(from_start(few, seed, 15.0, 0.3), stereo, SIX)
    assert is_accounted_for(estimate)
    # At 0.35° to a pixel the edges of this street hardly tell pitch from height.
    assert error_deg(estimate) < 0.8


def in_noise(window: Window) -> Window:
    """The window with images that show nothing."""
    camera, rng = window.rig.camera, np.random.default_rng(11)

    def dark(pair: FramePair) -> FramePair:
        pixels = rng.integers(0, 256, camera.height * camera.width).astype(np.uint8).tobytes()
        image = EncodedImage(ImageFormat.MONO8, camera.width, camera.height, pixels)
        return replace(pair, camera=replace(pair.camera, image=image))

    return replace(window, pairs=tuple(dark(pair) for pair in window.pairs))


def test_a_window_that_shows_nothing_leaves_a_known_start_where_it_was(few: Window) -> None:
    """Some wrong pose always fits by chance: a guess runs there, a calibration in use does not. Neither is accepted."""
    dark = in_noise(few)
    known = solve(replace(dark, start_known_to_rad=MOUNT_RAD), Noise())
    guess = solve(dark, Noise())
    assert known.verdict.decision is guess.verdict.decision is Decision.FAILED
    assert error_deg(known) < 3.0 < error_deg(guess)


def test_a_displacement_is_detected_although_the_start_was_known(few: Window, stereo: DepthModel) -> None:
    estimate = solve(replace(from_start(few, 1, 25.0), start_known_to_rad=MOUNT_RAD), stereo)
    assert error_deg(estimate) < 0.5


@pytest.mark.slow  # of kept windows the golden decisions tell the bytes of each objective
def test_same_input_same_bits(few: Window, stereo: DepthModel) -> None:
    first, second = (solve(from_start(few, 7, 10.0), stereo) for _ in range(2))
    assert first.optimum.T_camera_lidar.tobytes() == second.optimum.T_camera_lidar.tobytes()
    assert first.sigma.tobytes() == second.sigma.tobytes()
    assert first.verdict == second.verdict


def test_a_network_without_information_does_not_lead_out_of_the_basin_of_the_edges(
    few: Window, informed: Estimate
) -> None:
    uninformed = solve(from_start(few, 8, 5.0), Noise())
    separation = informed.optimum.T_camera_lidar @ se3.inverse(uninformed.optimum.T_camera_lidar)
    assert se3.rotation_angle_rad(separation) < SAME_BASIN_RAD
    # Walls and poles tell the yaw by their upright edges, which needs no depth.
    assert np.degrees(abs(uninformed.correction[1])) < 0.3


def swapped(window: Window, of_frame: Callable[[FramePair, FramePair], CameraFrame]) -> Window:
    """Every pair with something of the camera frame half a window away."""
    others = window.pairs[len(window.pairs) // 2 :] + window.pairs[: len(window.pairs) // 2]
    pairs = [replace(pair, camera=of_frame(pair, other)) for pair, other in zip(window.pairs, others, strict=True)]
    return replace(window, pairs=tuple(pairs))


def test_images_and_depth_of_other_frames_are_not_believed(few: Window, stereo: DepthModel) -> None:
    mixed = swapped(few, lambda pair, other: replace(pair.camera, image=other.camera.image, depth=other.camera.depth))
    estimate = solve(mixed, stereo)
    assert estimate.verdict.decision is Decision.FAILED
    assert is_accounted_for(estimate)


@pytest.mark.slow
def test_images_of_other_frames_are_not_believed(few: Window, stereo: DepthModel) -> None:
    mixed = swapped(few, lambda pair, other: replace(pair.camera, image=other.camera.image))
    assert solve(mixed, stereo).verdict.decision is Decision.FAILED


def test_a_window_without_intensity_cannot_be_solved_by_intensity(few: Window, stereo: DepthModel) -> None:
    bare = replace(
        few,
        pairs=tuple(replace(pair, lidar=replace(pair.lidar, intensity=None)) for pair in few.pairs),
    )
    with pytest.raises(CalibrationError, match="no intensity"):
        solve(bare, stereo, INTENSITY)


def test_an_image_that_cannot_be_decoded_is_an_error_that_names_its_frame(few: Window, stereo: DepthModel) -> None:
    pair = few.pairs[2]
    cut = replace(pair, camera=replace(pair.camera, image=replace(pair.camera.image, data=b"\xff\xd8")))
    broken = replace(few, pairs=(*few.pairs[:2], cut, *few.pairs[3:]))
    with pytest.raises(CalibrationError, match=f"images for the camera frame at {pair.stamp_ns} ns"):
        solve(broken, stereo)


def test_sweeps_without_a_jump_of_range_or_reflectance_are_an_error(few: Window, stereo: DepthModel) -> None:
    def on_a_sphere(pair: FramePair) -> FramePair:
        xyz_m = pair.lidar.xyz_m / np.linalg.norm(pair.lidar.xyz_m, axis=1, keepdims=True) * np.float32(10.0)
        return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m.astype(np.float32), intensity=None))

    with pytest.raises(CalibrationError, match="no edge of range or reflectance in any sweep"):
        solve(replace(few, pairs=tuple(on_a_sphere(pair) for pair in few.pairs)), stereo)


def test_a_start_beyond_the_reach_of_the_truth_ends_at_the_rim_or_is_refused(few: Window, stereo: DepthModel) -> None:
    near = FUSED.model_copy(update={"search": SearchConfig(reach_deg=4.0)})
    estimate = solve(from_start(few, 3, 8.0), stereo, near)
    assert estimate.verdict.decision is Decision.FAILED
    assert is_accounted_for(estimate)


def test_the_verdict_reports_how_far_the_answer_stands_out(informed: Estimate) -> None:
    metrics = {metric.name: metric for metric in informed.verdict.metrics}
    limits = FUSED.verdict
    assert (metrics["edge_contrast"].limit, metrics["edge_contrast"].at_least) == (limits.min_edge_contrast, True)
    assert (metrics["runner_up"].limit, metrics["runner_up"].at_least) == (limits.max_runner_up, False)
    assert metrics["edge_contrast"].value > 3.0
    assert metrics["runner_up"].value >= 0.0


def test_what_cannot_be_chance_to_one_cue_outranks_two_poor_showings(
    fusion: Fusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a garage with a network that has never seen one, a plain sum preferred 3.2 + 2.4 to 6.6 - 1.1."""

    def ranked(edges: float, depth: float) -> float:
        monkeypatch.setattr(Fusion, "contrasts_by_kind", lambda *_: [[edges]])
        monkeypatch.setattr(Fusion, "depth_contrasts", lambda *_: [depth])
        return fusion.rank(np.eye(4))

    assert ranked(6.6, -1.1) > ranked(3.2, 2.4)
    assert ranked(6.6, 2.0) > ranked(6.6, 1.0) > ranked(6.6, -5.0) == 6.6
