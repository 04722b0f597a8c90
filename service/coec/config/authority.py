"""Who may give commands."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from coec.config.base import ConfigModel, FilePath
from coec.schemas.commands import COMMAND_NAMES, CommandName

CommonName = Annotated[str, Field(pattern=r"^[A-Za-z0-9 ._:/@+=,-]{1,64}$")]
"""Common name of a certificate; X.509 allows 64 characters."""


class SenderConfig(ConfigModel):
    """A sender who may give commands, known by the common name of its certificate."""

    name: CommonName = Field(description="common name of the certificate")
    commands: tuple[CommandName, ...] = Field(
        default=COMMAND_NAMES, min_length=1, description="commands that this sender may give; all unless listed"
    )


class AuthorityConfig(ConfigModel):
    """Who may give commands, whatever the router lets through. A router does not tell the service who asks. A sender
    proves its name to the service itself, with a certificate signed by `root_ca`, in a TLS conversation inside the
    query (`coec query command/...` does this); a router in between can only hold such a command back. Senders without
    proof are `anonymous`. `loopback` accepts their commands while the session listens and connects on loopback only and
    the router's port is open on no other address. The service cannot see whether the router listens elsewhere, too. If
    it does, the router's own access control decides who gets in there; `never` refuses all anonymous commands."""

    anonymous: Literal["never", "loopback", "always"] = Field(
        default="loopback", description="when the service takes commands from senders without proof"
    )
    senders: tuple[SenderConfig, ...] = Field(default=(), max_length=64, description="who may give which commands")
    certificate: FilePath | None = Field(
        default=None, description="certificate of the service; its common name is the vehicle's name"
    )
    private_key: FilePath | None = Field(default=None, description="private key of `certificate`")
    root_ca: FilePath | None = Field(default=None, description="authority that signed the senders' certificates")

    @model_validator(mode="after")
    def _provable(self) -> AuthorityConfig:
        given = [path is not None for path in (self.certificate, self.private_key, self.root_ca)]
        if any(given) != all(given):
            raise ValueError("certificate, private_key and root_ca belong together: give all three or none")
        if self.senders and not all(given):
            raise ValueError("senders prove their names to the service: give certificate, private_key and root_ca, too")
        names = [sender.name for sender in self.senders]
        if len(set(names)) != len(names):
            raise ValueError("names of senders must be unique")
        return self
