"""How far the drive may go ahead of the service, so that the story does not depend on how fast the machine is."""

from __future__ import annotations

from dataclasses import dataclass

from coec.schemas import replies

NS_PER_S = 1_000_000_000

LEAD_NS = 7 * NS_PER_S
"""The drive waits while it is so far ahead of what the service has judged: a check of the monitor, and a little."""

STEP_NS = 2 * NS_PER_S
"""A service that has nothing to do with all that it got (no checks are taken soon after a window) gets so much more."""

ON_THE_WAY = 1
"""Pictures that may still be under way, or lost without a trace, when the service is said to have them all."""


@dataclass(slots=True)
class Pace:
    """How far the drive may go.

    Attributes:
        judged_ns: sensor time up to which the service has judged, or for which it gets no more to judge.
    """

    judged_ns: int

    def saw(self, judged_ns: int | None, *, at_rest: bool, stamp_ns: int) -> None:
        """What the service says.

        Args:
            judged_ns: up to which sensor time it has judged; None: nothing yet.
            at_rest: whether it has nothing to do although it has all that was sent.
            stamp_ns: sensor time up to which the drive was sent when it was asked.
        """
        self.judged_ns = max(self.judged_ns, judged_ns or 0)
        if at_rest:
            self.judged_ns = max(self.judged_ns, stamp_ns + STEP_NS - LEAD_NS)

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return stamp_ns <= self.judged_ns + LEAD_NS


def at_rest(worker: replies.WorkerStatus, pair: replies.PairStatus, sent: int) -> bool:
    """Whether the service has got so many pictures and has nothing to do with them.

    What it says of its worker and its pairs is of one instant, and renewed every second.
    """
    arrived = pair.camera.received + sum(pair.camera.losses.values())
    idle = worker.state == "idle" and not worker.queued and not pair.held and not pair.unanswered
    return idle and arrived + ON_THE_WAY >= sent
