"""Commands on the wire: their names, and the form of one that its sender proves."""

from __future__ import annotations

from typing import Final, Literal, get_args

from pydantic import Field

from coec.schemas.base import Message

CommandName = Literal["calibrate", "apply", "rollback", "reset", "commission", "hold"]
"""Of CONTRACT."""

NAMES: Final[tuple[CommandName, ...]] = get_args(CommandName)


class ProvenCommand(Message):
    """What the sender of a command says inside a TLS conversation (`command/<name>?tls=<conversation>`)."""

    selector: str = Field(
        description="the key of the command and its parameters, as they would stand in a query without proof: what was "
        "meant for one pair or command cannot be turned into another"
    )
    payload: str = Field(default="", description="arguments of the command, a JSON object; empty: none")
