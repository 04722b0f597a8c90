"""How far the drive may be ahead of the service, so that the story does not depend on the speed of the machine."""

from __future__ import annotations

from dataclasses import dataclass

from coec.schemas import replies

NS_PER_S = 1_000_000_000

LEAD_NS = 7 * NS_PER_S
"""The drive waits while it is so far ahead of what the service has judged: one check of the monitor, and a little."""

STEP_NS = 2 * NS_PER_S
"""A service that is idle although it has everything (no checks follow soon after a window) gets so much more."""

ON_THE_WAY = 1
"""Pictures that may still be in transit, or lost without a trace, when the service counts as having them all."""


@dataclass(slots=True)
class Pace:
    """How far the drive may go.

    Attributes:
        judged_ns: sensor time up to which the service has judged, or has nothing left to judge.
    """

    judged_ns: int

    def saw(self, judged_ns: int | None, *, at_rest: bool, stamp_ns: int) -> None:
        """Takes in what the service says.

        Args:
            judged_ns: sensor time up to which it has judged; None: nothing yet.
            at_rest: whether it is idle although it has everything that was sent.
            stamp_ns: sensor time up to which the drive had been sent when the service was asked.
        """
        self.judged_ns = max(self.judged_ns, judged_ns or 0)
        if at_rest:
            self.judged_ns = max(self.judged_ns, stamp_ns + STEP_NS - LEAD_NS)

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return stamp_ns <= self.judged_ns + LEAD_NS


def at_rest(worker: replies.WorkerStatus, pair: replies.PairStatus, sent: int) -> bool:
    """Whether the service has received `sent` pictures and is idle.

    What it says about its worker and its pairs is from one instant, and is renewed every second.
    """
    arrived = pair.camera.received + sum(pair.camera.losses.values())
    idle = worker.state == "idle" and not worker.queued and not pair.held and not pair.unanswered
    return idle and arrived + ON_THE_WAY >= sent
