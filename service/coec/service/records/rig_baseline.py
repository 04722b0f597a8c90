"""The baseline of a rig, its own or that of its model, as long as it fits: the learned limits and bias, or why the
baseline is not used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.calibration import state as lifecycle
from coec.calibration.baseline import Baseline, BaselineDrift, drift, learned_hash, mismatch
from coec.calibration.types import Estimate, Matrix4, Reason, Rig
from coec.config import CalibrationConfig, PairConfig, StateConfig
from coec.errors import StateError
from coec.geometry import se3
from coec.io.baseline_file import BASELINES, baseline_of_rig, load_baseline, save_baseline


class RigBaseline:
    """Belongs to the thread that decides about the pair; `flush` is for the scribe.

    Attributes:
        trouble: why an existing baseline is not used; else None.
    """

    def __init__(self, pair: PairConfig, rig: Rig, state: StateConfig) -> None:
        self._pair = pair
        self._rig = rig
        self._state = state
        self._baseline: Baseline | None = None
        self._own: Baseline | None = None
        self.problem: Reason | None = None
        self.load()

    def load(self) -> None:
        """Reads the baseline from the disk, where the worker writes it."""
        self._baseline, self.problem = None, None
        try:
            self._own = load_baseline(self._state.directory / BASELINES, self._rig.pair)
            baseline = baseline_of_rig(self._rig, self._state)
        except StateError as error:
            self.problem = Reason("baseline_damaged", f"The baseline of the rig cannot be used: {error}")
            return
        if baseline is None:
            return
        wrong = mismatch(baseline, self._rig, baseline.depth_identity, learned_hash(self._pair.calibration))
        if wrong is None:
            self._baseline = baseline
        else:
            self.problem = _mismatched(wrong)

    def flush(self) -> None:
        """Writes the rig's own baseline again if somebody has removed it.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        path, own = self._state.directory / BASELINES, self._own
        try:
            there = load_baseline(path, self._rig.pair)
        except StateError:
            return  # a damaged file stays, so that people can look into it
        if own is not None and there is None:
            save_baseline(path, own)

    def reconfigure(self, pair: PairConfig) -> None:
        """Goes on with other settings, which the baseline may not fit."""
        self._pair = pair
        self.load()

    def refuse(self, why: str) -> bool:
        """Stops using the baseline because it does not fit after all. Returns whether it was in use."""
        if self._baseline is None:
            return False
        self._baseline, self.problem = None, _mismatched(why)
        return True

    def fits_network(self, depth_identity: str) -> bool:
        """Whether the baseline was made with the network that the worker has opened; True without a baseline."""
        return self._baseline is None or self._baseline.depth_identity == depth_identity

    @property
    def calibration(self) -> CalibrationConfig:
        """The configuration for windows: with the limits that were learned on this rig, if there is a baseline."""
        configured = self._pair.calibration
        if self._baseline is None:
            return configured
        return configured.model_copy(update={"verdict": self._baseline.verdict(configured.verdict)})

    def unbiased(self, estimate: Estimate) -> Estimate:
        """The estimate with the estimator's bias on this rig taken out."""
        if self._baseline is None:
            return estimate
        return lifecycle.moved(estimate, self._baseline.unbiased(estimate.optimum.T_camera_lidar), self._rig)

    def moved(self, estimate: Estimate, pose: Matrix4) -> Estimate:
        """The estimate with another pose (4, 4), from which the estimator's bias has been taken out."""
        return lifecycle.moved(estimate, pose, self._rig)

    def drift(self, T_camera_lidar: Matrix4, sigma: NDArray[np.float64] | None) -> BaselineDrift | None:
        """Drift from the commissioned calibration to a pose (4, 4) without bias, whose standard deviations are `sigma`
        (6,) (None: unknown). None before commissioning."""
        if self._baseline is None:
            return None
        known = np.full(6, np.nan) if sigma is None else sigma
        return drift(se3.perturb(T_camera_lidar, self._baseline.bias), known, self._baseline)


def _mismatched(text: str) -> Reason:
    return Reason("baseline_mismatch", f"The baseline of the rig is not used: {text}")
