"""Commands on the wire: names and arguments, the form of a command whose sender proves its name, and the answer."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, get_args

from pydantic import Field

from coec.schemas.message import Message, Text

CommandName = Literal["calibrate", "apply", "rollback", "reset", "commission", "hold"]
"""Commands of CONTRACT."""

COMMAND_NAMES: Final[tuple[CommandName, ...]] = get_args(CommandName)


@dataclass(frozen=True, slots=True)
class Argument:
    """One entry of a command's payload, a JSON object."""

    name: str
    kind: type
    meaning: str


RELEASE: Final = Argument("release", bool, "let go of what is held")
TO: Final = Argument(
    "to",
    str,
    "id of an accepted window, or the beginning of a sha256 of `history`: what was served then is served again",
)
CANDIDATE: Final = Argument(
    "candidate",
    str,
    "id of a window, or the beginning of the sha256 of the candidate in `extrinsic`: only this candidate is applied",
)
REASON: Final = Argument(
    "reason", str, "why, for whoever asks later: stands in `history`, that of a `hold` in `extrinsic` and `health`"
)
SENSOR: Final = Argument("sensor", str, "of the rig: all pairs of this sensor, and no others")

PAIR_ARGUMENTS: Final[Mapping[str, tuple[Argument, ...]]] = {
    "apply": (CANDIDATE,),
    "rollback": (TO,),
    "hold": (RELEASE,),
}
"""What the payload of each command may hold beside the reason, which all commands take."""

MAX_REASON: Final = 200
"""Most characters of a reason, about two sentences. In UTF-8 they stay far below the limit of a payload."""


def arguments_of(command: str, *, for_rig: bool) -> tuple[Argument, ...]:
    """What the payload of a command may hold, for a pair or for the rig. For the rig there is neither `to` nor
    `candidate`, because a window belongs to one pair."""
    arguments = (*PAIR_ARGUMENTS.get(command, ()), REASON)
    return (*(argument for argument in arguments if argument not in (TO, CANDIDATE)), SENSOR) if for_rig else arguments


class ProvenCommand(Message):
    """What the sender of a command sends inside a TLS conversation (`command/<name>?tls=<conversation>`)."""

    selector: str = Field(
        description="key and parameters of the command, as in a query without proof, so that nobody can redirect it to "
        "another pair or command"
    )
    payload: str = Field(default="", description="arguments of the command, a JSON object; empty: none")


class Acknowledgement(Message):
    """The answer to a command that was understood: whether it is carried out."""

    vehicle: Text
    pair: Text
    command: Text
    accepted: bool
    code: Text = Field(description="machine-readable outcome")
    text: Text = Field(description="one sentence")
    window_id: Text | None = Field(default=None, description="the window it acts on")
    durable: bool | None = Field(
        default=None,
        description="whether the effect is on the disk, safe from a power cut; false: not yet, and `health` says what "
        "is wrong with the disk; null if nothing was done",
    )
