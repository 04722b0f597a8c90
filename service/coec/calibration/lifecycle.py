"""What is served as the extrinsic of a pair, and how healthy it is: pure functions from state to state.

An estimate that was not accepted is never served as current; a pair that was not looked at is never healthy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

from coec.calibration.values import Decision, Estimate, Matrix4, Reason, Rig


class Provenance(StrEnum):
    """Where the served extrinsic comes from."""

    NOMINAL = "nominal"
    COMMISSIONED = "commissioned"
    ESTIMATED = "estimated"
    RESTORED = "restored"


class Status(StrEnum):
    """How the latest calibration ended; `not_accepted` before the first."""

    NOT_ACCEPTED = "not_accepted"
    ACCEPTED = "accepted"
    FAILED = "failed"


class HealthState(StrEnum):
    """States of `health` (CONTRACT). `unknown` is the state of not having looked."""

    UNKNOWN = "unknown"
    HEALTHY = "healthy"
    SUSPECT = "suspect"
    MISCALIBRATED = "miscalibrated"
    DEGRADED = "degraded"
    STALE = "stale"


@dataclass(frozen=True, slots=True, eq=False)
class PairState:
    """Everything that survives a restart.

    Attributes:
        T_camera_lidar: (4, 4) the extrinsic that is served.
        valid_from_ns: sensor time of the data it rests on; 0 for the nominal one.
        latest: the last estimate, accepted or not.
        accepted: the last accepted estimate.
        failures: why the last attempt produced no estimate; empty when it produced one.
    """

    T_camera_lidar: Matrix4
    provenance: Provenance
    status: Status
    valid_from_ns: int
    latest: Estimate | None = None
    accepted: Estimate | None = None
    failures: tuple[Reason, ...] = ()


@dataclass(frozen=True, slots=True)
class Health:
    """The state with its reasons; `since_ns` is kept by whoever has a clock."""

    state: HealthState
    reasons: tuple[Reason, ...]


def initial_state(rig: Rig) -> PairState:
    """Nominal, not accepted, nothing looked at."""
    return PairState(rig.T_camera_lidar_nominal, Provenance.NOMINAL, Status.NOT_ACCEPTED, 0)


def restored(state: PairState) -> PairState:
    """The state after a restart: an estimate that was read back from disk says so."""
    if state.provenance is Provenance.ESTIMATED:
        return replace(state, provenance=Provenance.RESTORED)
    return state


def after_estimate(state: PairState, estimate: Estimate) -> PairState:
    """An accepted estimate becomes current; a failed one changes the status only."""
    if estimate.verdict.decision is Decision.FAILED:
        return replace(state, status=Status.FAILED, latest=estimate, failures=())
    return PairState(
        T_camera_lidar=estimate.optimum.T_camera_lidar,
        provenance=Provenance.ESTIMATED,
        status=Status.ACCEPTED,
        valid_from_ns=estimate.data_stamp_ns,
        latest=estimate,
        accepted=estimate,
    )


def after_failure(state: PairState, reason: Reason) -> PairState:
    """A window from which no estimate could be made: the served extrinsic stays."""
    return replace(state, status=Status.FAILED, failures=(reason,))


def assess(state: PairState, age_s: float | None, stale_after_s: float) -> Health:
    """Health from the state and the age of the latest evaluated window in seconds (None: none was evaluated)."""
    if age_s is None or (state.latest is None and not state.failures):
        return Health(HealthState.UNKNOWN, (Reason("not_evaluated", "No window has been evaluated yet."),))
    if age_s > stale_after_s:
        text = f"The last evaluation is {age_s:.0f} s old, more than {stale_after_s:.0f} s."
        return Health(HealthState.STALE, (Reason("stale", text),))
    if state.failures:
        return Health(HealthState.DEGRADED, state.failures)
    if state.latest is not None and state.latest.verdict.decision is Decision.FAILED:
        return Health(HealthState.SUSPECT, state.latest.verdict.reasons)
    return Health(HealthState.HEALTHY, ())
