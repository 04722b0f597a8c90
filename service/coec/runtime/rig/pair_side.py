"""The rig as the threads of one pair use it: what the pair reports to it, and what it tells the pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.lifecycle import PairState
from coec.calibration.monitor.change_detector import Observation, new_share
from coec.calibration.rig.evidence import EdgeObservation, observation_of_check
from coec.calibration.rig.vehicle import EdgeWindow, JointPose, ServedEdge
from coec.calibration.tracker import Measurement, prior_sigma
from coec.calibration.types import Estimate, Matrix4
from coec.config import PairConfig
from coec.runtime.recording.window_store import start_ns_of

PairReport = EdgeObservation | EdgeWindow | ServedEdge
"""What a pair may report."""


@dataclass(frozen=True, slots=True, eq=False)
class PairCorrection:
    """A correction of one pair, which was decided at a sensor time together with those of the other pairs.

    Attributes:
        from_ns: sensor time from which it counts.
        text: why, in one sentence.
    """

    joint_pose: JointPose
    stamp_ns: int
    from_ns: int
    text: str


class RigReports(Protocol):
    """The rig; see `keeper`."""

    def put(self, pair: str, due_ns: int | None, report: PairReport) -> None:
        """Takes in a report of a pair that counts from a sensor time on (None: from now on)."""

    def report_time(self, pair: str, stamp_ns: int, *, waits: bool) -> bool:
        """A pair has frames of this sensor time. If it `waits`, answers to its own questions are missing; else it has
        made all its reports up to there. Returns whether the rig may still tell it something that counts by then."""

    def step_back(self, pair: str, stamp_ns: int) -> None:
        """Sensor time has stepped back for a pair, to this stamp."""

    def corrections(self, pair: str, stamp_ns: int) -> list[PairCorrection]:
        """Corrections of a pair that count from this sensor time or an earlier one; each is returned once."""

    def pop_window_request(self, pair: str, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants pairs of frames for a window, if the wish counts by `stamp_ns`;
        returned once."""


class RigMember:
    """One pair of the rig. The thread that decides about the pair makes its reports; the thread of its stream takes
    what the rig tells it."""

    def __init__(self, pair: PairConfig, rig: RigReports) -> None:
        self._name = pair.name
        self._prior = prior_sigma(pair.tracker)
        self._rig = rig

    # --- on the thread that decides ---------------------------------------------------------------------------------

    def on_check(self, due_ns: int, before: PairState, after: PairState, observation: Observation) -> None:
        """A check of the extrinsic that was served `before` was completed."""
        share = new_share(before.monitor, observation)
        edge_observation = observation_of_check(
            self._name, before.T_camera_lidar, observation, share, after.flagged_since_ns
        )
        if edge_observation is not None:
            self._rig.put(self._name, due_ns, edge_observation)

    def accepted(self, due_ns: int | None, estimate: Estimate) -> None:
        """A window was accepted."""
        self._rig.put(
            self._name, due_ns, EdgeWindow(Measurement.from_estimate(estimate), start_ns_of(estimate.window_id))
        )

    def serves(self, due_ns: int | None, state: PairState) -> None:
        """Another extrinsic is served from now on."""
        self._rig.put(self._name, due_ns, served_by(state, self._prior))

    # --- on the thread of the stream --------------------------------------------------------------------------------

    def must_wait(self, stamp_ns: int, *, for_own: bool) -> bool:
        """Whether the rig may still tell something that counts before a pair of frames of this stamp is looked at.
        `for_own`: the pair waits for answers to its own questions anyway."""
        return self._rig.report_time(self._name, stamp_ns, waits=for_own)

    def corrections(self, stamp_ns: int) -> list[PairCorrection]:
        """Corrections that count before a pair of frames of this stamp is looked at; each is returned once."""
        return self._rig.corrections(self._name, stamp_ns)

    def pop_window_request(self, stamp_ns: int) -> int | None:
        """Sensor time since which the rig wants pairs of frames for a window, asked before a pair of this stamp is
        looked at; returned once. None: it wants no window."""
        return self._rig.pop_window_request(self._name, stamp_ns)

    def time_stepped_back(self, stamp_ns: int) -> None:
        """The clock of the sensors has stepped back, to this stamp."""
        self._rig.step_back(self._name, stamp_ns)


JoinRig = Callable[[PairConfig, PairState], RigMember]
"""Adds a pair to the rig, with what it serves at its start."""


def served_by(state: PairState, prior: NDArray[np.float64]) -> ServedEdge:
    """What a pair serves; `prior` (6,) is how far the nominal calibration may be off (rad, m)."""
    pose: Matrix4 = state.T_camera_lidar
    if state.accepted is None:
        return ServedEdge(pose, prior, None)
    track = state.track
    known = (
        None
        if track is None or not track.windows
        else Measurement(track.T_camera_lidar, track.uncertainty, track.stamp_ns)
    )
    return ServedEdge(pose, state.accepted.sigma, start_ns_of(state.accepted.window_id), known)
