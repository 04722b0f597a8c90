"""Urgent windows on rendered drives of a rig: when a pair suspects a move, the frames of the next seconds are solved,
as on the vehicle (`calibration.monitor.urgency`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from coec.adapters.depth.maps import open_depth
from coec.adapters.images.codec import CachedGreys, GreyImages
from coec.calibration.calibrator import calibrate
from coec.calibration.lifecycle import (
    CalibrationStatus,
    PairRules,
    PairState,
    Provenance,
    after_observation,
    urgent_window_since,
)
from coec.calibration.monitor.change_detector import MonitorState, Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.monitor.urgency import TRIES
from coec.calibration.ports import Silence
from coec.calibration.rig.evidence import EdgeObservation, observation_of_window
from coec.calibration.search.mount_prior import MOUNT_RAD
from coec.calibration.tracker import Measurement
from coec.calibration.types import Decision, FramePair, Matrix4, Uncertainty, Window
from coec.config import CalibrationConfig, LimitsConfig, MonitorConfig, PolicyConfig, TrackerConfig, WindowConfig
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.knocked_drive import LIDAR, DisplacedRigDrive
from coec.evaluation.places import evenly
from coec.evaluation.rig_looks import PERIOD_S
from coec.evaluation.rig_windows import SLICE_S
from coec.geometry import se3
from coec.schemas.rig import Mounts, RigLook, RigWindow
from coec.simulation.journey import START_NS

NS_PER_S = 1_000_000_000
MONITOR = MonitorConfig(period_s=PERIOD_S, pairs=CHECK_PAIRS)
RULES = PairRules(PolicyConfig(), TrackerConfig(), MONITOR)

SOLVE_S = 4.5
"""The worker takes four seconds for a window of 25 frames."""

WAITING = {Mounts.AS_BUILT: 1, Mounts.CAMERA: 2, Mounts.LIDAR: 4}
"""How many windows the worker solves one after the other: those of both knocked cameras, or of all pairs of the LiDAR.
Each counts once all are solved."""

CONFIGURATION = CalibrationConfig()

FramesByMount = Mapping[tuple[str, Mounts], Sequence[FramePair]]
"""The pairs of a drive by camera, and by which of their sensors has moved since the knock, ascending."""


def pair_at(pose: Matrix4) -> PairState:
    """A pair that serves `pose` (4, 4), which a window has confirmed."""
    return PairState(
        pose, Provenance.ESTIMATED, CalibrationStatus.ACCEPTED, START_NS, monitor=MonitorState(vouched=True)
    )


def variant(checks: Sequence[RigLook], edge: str, mounts: Mounts) -> Iterator[RigLook]:
    """The looks at an edge, from the knock on with its sensors as `mounts` says."""
    by_stamp: dict[int, dict[Mounts, RigLook]] = {}
    for check in checks:
        if check.edge == edge:
            by_stamp.setdefault(check.pair_stamps_ns[-1], {})[check.mounts] = check
    for of in by_stamp.values():
        yield of.get(mounts, of[Mounts.AS_BUILT])


def urgent_windows(drive: DisplacedRigDrive, frames: FramesByMount, checks: Sequence[RigLook]) -> Iterator[RigWindow]:
    """The windows for which the pairs of a drive ask, as far as their answers come before its end.

    Raises:
        CalibrationError: an image cannot be decoded.
    """
    for (camera, mounts), pairs in frames.items():
        edge = f"{camera}-{LIDAR}"
        late_ns = answer_ns(mounts)
        for begin_ns in request_stamps_ns(drive.served[edge], variant(checks, edge, mounts), late_ns):
            of_slice = [pair for pair in pairs if begin_ns < pair.stamp_ns <= begin_ns + SLICE_S * NS_PER_S]
            if pairs[-1].stamp_ns >= begin_ns + late_ns:
                selected = tuple(of_slice[index] for index in evenly(len(of_slice), WindowConfig().pairs))
                yield _solved(drive, camera, mounts, selected, begin_ns + late_ns)


def answer_ns(mounts: Mounts) -> int:
    """From the look after which a pair suspects a move to the answer of its window."""
    return round((SLICE_S + WAITING[mounts] * SOLVE_S) * NS_PER_S)


def request_stamps_ns(pose: Matrix4, checks: Iterator[RigLook], late_ns: int) -> Iterator[int]:
    """When a pair that serves `pose` (4, 4) asks for a window: at most `TRIES` times per suspicion, and not again
    before the answer, which comes `late_ns` after it."""
    pair, tries, known_ns = pair_at(pose), 0, START_NS
    for check in checks:
        observation = observation_of(check)
        pair = after_observation(pair, observation, RULES)
        if urgent_window_since(pair) is None:
            tries = 0
        elif tries < TRIES and observation.stamp_ns >= known_ns:
            tries += 1
            known_ns = observation.stamp_ns + late_ns
            yield observation.stamp_ns


def _solved(
    drive: DisplacedRigDrive, camera: str, mounts: Mounts, pairs: tuple[FramePair, ...], known_ns: int
) -> RigWindow:
    rig = drive.right.pair(camera, LIDAR).rig
    pose = drive.served[rig.pair]
    window = Window(f"{rig.pair}-{pairs[0].stamp_ns}", rig, pose, pairs, MOUNT_RAD)
    images = CachedGreys(GreyImages(LimitsConfig()), len(pairs))
    estimate = calibrate(window, open_depth(CONFIGURATION.depth, LimitsConfig()), images, CONFIGURATION, Silence())
    uncertainty = Measurement.from_estimate(estimate).uncertainty
    document = {
        "edge": rig.pair,
        "mounts": mounts,
        "first_ns": pairs[0].stamp_ns,
        "last_ns": pairs[-1].stamp_ns,
        "known_ns": known_ns,
        "accepted": estimate.verdict.decision is Decision.ACCEPTED,
        "reasons": [one.code for one in estimate.verdict.reasons],
        "offset": se3.difference(estimate.optimum.T_camera_lidar, pose).tolist(),
        "noise": [[value if isfinite(value) else None for value in row] for row in uncertainty.noise.tolist()],
        "systematic": {name: shift.tolist() for name, shift in uncertainty.systematic.items()},
    }
    return RigWindow.model_validate(document)


def window_evidence(window: RigWindow, pose: Matrix4) -> EdgeObservation | None:
    """An accepted window of a pair that served `pose` (4, 4) as attribution takes it; None if it determines no axis.
    All of its frames lie after a step only if the first one does."""
    noise = np.array([[np.nan if value is None else value for value in row] for row in window.noise])
    systematic = {name: np.array(shift) for name, shift in window.systematic.items()}
    measured = Measurement(
        se3.perturb(pose, np.array(window.offset)), Uncertainty(noise, systematic, np.nan), window.last_ns
    )
    evidence = observation_of_window(window.edge, measured)
    return None if evidence is None else replace(evidence, stamp_ns=window.first_ns)


def observation_of(check: RigLook) -> Observation:
    """The look as the change detector takes it, without the figures that decide nothing."""
    offset, sigma, noise, place = (np.array(six) for six in (check.offset, check.sigma, check.noise, check.place))
    return Observation(
        stamp_ns=check.pair_stamps_ns[-1], pair_stamps_ns=check.pair_stamps_ns, metrics=(), offset=offset, sigma=sigma,
        noise=noise, place=place, dispersion=check.dispersion, distance2=check.distance2, flagged=check.flagged,
        weak=check.weak, flagged_by_paper=None, causes=tuple(CAUSES[code] for code in check.causes),
    )  # fmt: skip
