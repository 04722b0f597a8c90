"""What is served as the extrinsic of a pair, and how healthy it is: pure functions from state to state.

`states` holds the machine and its table, `policy` what may be applied without a person, `pair_state` the flow.
docs/health.md shows the table.
"""

from coec.calibration.lifecycle.pair_state import (
    Candidate,
    CommandRefusedError,
    Health,
    PairState,
    Provenance,
    Rules,
    Status,
    after_commissioning,
    after_estimate,
    after_failure,
    after_observation,
    aged,
    agrees,
    apply_pending,
    before_estimate,
    held,
    initial_state,
    moved,
    overdue,
    released,
    reset,
    restored,
    rolled_back,
    time_stepped_back,
    window_wanted_since,
)
from coec.calibration.lifecycle.policy import Change
from coec.calibration.lifecycle.states import MEANING, TRANSITIONS, Event, HealthState, markdown

__all__ = [
    "MEANING",
    "TRANSITIONS",
    "Candidate",
    "Change",
    "CommandRefusedError",
    "Event",
    "Health",
    "HealthState",
    "PairState",
    "Provenance",
    "Rules",
    "Status",
    "after_commissioning",
    "after_estimate",
    "after_failure",
    "after_observation",
    "aged",
    "agrees",
    "apply_pending",
    "before_estimate",
    "held",
    "initial_state",
    "markdown",
    "moved",
    "overdue",
    "released",
    "reset",
    "restored",
    "rolled_back",
    "time_stepped_back",
    "window_wanted_since",
]
