"""Whether an act came true: the knocked sensor is named, and no other ever is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from coec_lab.demo.rig import story
from coec_lab.demo.rig.story import Act
from coec_lab.demo.rig.told import Told


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one act.

    Attributes:
        named_s: second of the drive from which the knocked sensor alone was named to the end; None: never.
        wrong: sensors that were named at any time although they had not moved.
    """

    act: Act
    named_s: float | None
    wrong: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the act came true."""
        return not self.objections()

    def objections(self) -> tuple[str, ...]:
        """What did not come true, one sentence each."""
        said = [f"{name} was said to have moved, and had not." for name in self.wrong]
        if self.named_s is None:
            said.append(f"{self.act.sensor} was knocked, and is not named at the end.")
        return tuple(said)


def outcome_of(act: Act, heard: Sequence[Told]) -> Outcome:
    """The outcome from everything that was said, in order."""
    wrong: set[str] = set()
    named_s: float | None = None
    for told in heard:
        moved = {act.sensor} if told.second >= story.KNOCK_S else set()
        wrong |= told.named - moved
        if told.named != {act.sensor}:
            named_s = None
        elif named_s is None:
            named_s = told.second
    return Outcome(act, named_s, tuple(sorted(wrong)))


def is_over(outcome: Outcome, told: Told) -> bool:
    """Whether the act may end, because the right name has lasted for `REST_S`."""
    return outcome.named_s is not None and told.second >= outcome.named_s + story.REST_S
