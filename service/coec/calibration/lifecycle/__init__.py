"""What is served as the extrinsic of a pair, and how healthy it is: pure functions from state to state.

`states` holds the machine and its table, `policy` what may be applied without a person, `pair_state` the flow.

Health, by what happens (rows) and the state it happens in (columns); `states.MEANING` has a sentence for each event:

|                          | unknown       | healthy       | suspect       | miscalibrated | degraded      | stale         |
| ------------------------ | ------------- | ------------- | ------------- | ------------- | ------------- | ------------- |
| window_agrees            | healthy       | ·             | healthy       | healthy       | healthy       | healthy       |
| window_contradicts       | miscalibrated | miscalibrated | miscalibrated | ·             | miscalibrated | miscalibrated |
| window_differs           | suspect       | suspect       | ·             | ·             | suspect       | suspect       |
| window_refused_elsewhere | suspect       | suspect       | ·             | ·             | suspect       | suspect       |
| monitor_clear            | healthy       | ·             | healthy       | suspect       | healthy       | healthy       |
| monitor_no_objection     | ·             | ·             | ·             | suspect       | unknown       | unknown       |
| monitor_suspects         | suspect       | suspect       | ·             | ·             | suspect       | suspect       |
| monitor_confirms         | miscalibrated | miscalibrated | miscalibrated | ·             | miscalibrated | miscalibrated |
| data_cause               | degraded      | degraded      | degraded      | ·             | ·             | degraded      |
| check_overdue            | ·             | degraded      | degraded      | ·             | ·             | ·             |
| aged                     | ·             | stale         | stale         | ·             | stale         | ·             |
| replaced                 | ·             | unknown       | unknown       | unknown       | unknown       | unknown       |
| time_stepped_back        | ·             | unknown       | ·             | ·             | unknown       | unknown       |
| restarted                | ·             | unknown       | ·             | ·             | unknown       | unknown       |
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
]
